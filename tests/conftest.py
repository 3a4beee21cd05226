"""Settings shared by all tests. A warning is an error (pyproject.toml); pictures are drawn into memory."""

import os

from hypothesis import settings

os.environ["MPLBACKEND"] = "Agg"  # for this process and for the commands and notebooks that tests start

# The first example of a law compiles what the others reuse, so a deadline would time the compiler.
settings.register_profile("hjbjax", deadline=None, print_blob=True)
settings.load_profile("hjbjax")
