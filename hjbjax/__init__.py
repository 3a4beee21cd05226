"""hjbjax: Hamilton–Jacobi–Bellman and Isaacs equations on grids, with JAX."""

import sys

from hjbjax._version import __version__ as __version__

TYPE_CHECKING = False  # True for type checkers; the constant of typing would take 10 ms to import

if TYPE_CHECKING:
    from typing import Any

    from hjbjax._names import *  # noqa: F403
    from hjbjax._names import __all__ as __all__

LATER = ("filtering", "neural", "plotting", "zoo")  # imported on first use: a third of the import time of the package


def __getattr__(name: str) -> "Any":
    """A public name, imported on first use.

    Importing JAX and the package takes more than a second. The command line parses its arguments, prints its help and
    handles Ctrl-C before that, and ``hjbjax doctor`` can report a broken JAX installation without a traceback.
    """
    import importlib

    if name in LATER:
        return importlib.import_module(f"hjbjax.{name}")
    if name == "__all__" or not name.startswith("__"):  # inspect and doctest ask for special names that do not exist
        public = importlib.import_module("hjbjax._names")
        if name == "__all__" or name in public.__all__:
            globals()[name] = found = getattr(public, name)
            return found
        if name in globals():  # a subpackage that has been imported meanwhile
            return globals()[name]
        from hjbjax.problem import words

        if name.lower() in words.OF_PACKAGE:
            raise AttributeError(words.missing(f"module {__name__!r}", name, words.OF_PACKAGE), name=name)
    # with ``name=`` and ``obj=``, from which Python derives its suggestion
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    return sorted(__getattr__("__all__"))
