"""Settings shared by all tests. A warning is an error (pyproject.toml); pictures are drawn into memory."""

import gc
import os

from hypothesis import settings

os.environ["MPLBACKEND"] = "Agg"  # for this process and for the commands and notebooks that tests start

# Traced programs are millions of objects that stay: looking through them again and again finds nothing.
gc.set_threshold(100_000, 20, 20)

# The first example of a law compiles what the others reuse, so a deadline would time the compiler.
settings.register_profile("hjbjax", deadline=None, print_blob=True)
settings.load_profile("hjbjax")
