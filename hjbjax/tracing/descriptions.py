"""Digests of Python objects for checkpoints: the same in every process, and different for different data.

A jaxpr contains a host function as an object, and a run has a method and a scheme, which a user may have written. A run
that is resumed in another process has other objects, so they are described by their code and by everything that it
reads: defaults, closures, globals, attributes, and the functions that it calls. Arrays are described by their bytes,
because printing rounds and abridges them. Code of installed packages is described by its name.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import sysconfig
import types
from functools import cached_property
from typing import Any

import jax
import numpy as np

from hjbjax.tracing.outside import ADDRESS, ByCode, content, is_of_library, names_read

PLAIN = (type(None), bool, int, float, complex, str, bytes)
INSTALLED = tuple(sysconfig.get_path(name) for name in ("purelib", "platlib"))


def digest_of(thing: object) -> str:
    """A digest of an object, also of a host function as ``outside.fingerprint`` lists it."""
    found = _described(thing.function if isinstance(thing, ByCode) else thing, {})
    return hashlib.blake2b(repr(found).encode(), digest_size=16).hexdigest()


def _described(thing: Any, known: dict[int, int]) -> Any:
    """Nested tuples of text for an object; ``known`` numbers the objects that have been described."""
    if isinstance(thing, PLAIN):
        return repr(thing)
    if isinstance(thing, (np.ndarray, np.generic, jax.Array)):
        return _of_array(np.asarray(thing), known)
    if isinstance(thing, (tuple, list, dict)):
        entries = thing.items() if isinstance(thing, dict) else thing
        return type(thing).__name__, [_described(each, known) for each in entries]
    if isinstance(thing, (set, frozenset)):  # the order differs between processes
        return "set", sorted(repr(_described(each, known)) for each in thing)
    if isinstance(thing, types.CodeType):  # without line numbers and addresses
        return thing.co_code, thing.co_names, [_described(each, known) for each in thing.co_consts]
    if isinstance(thing, types.MethodType):
        return "method", _described(thing.__func__, known), _described(thing.__self__, known)
    if isinstance(thing, types.ModuleType):
        return "module", thing.__name__
    if id(thing) in known:  # functions may call each other, and objects may hold each other
        return "again", known[id(thing)]
    known[id(thing)] = len(known)
    if isinstance(thing, functools.partial):
        return "partial", [_described(each, known) for each in (thing.func, thing.args, thing.keywords)]
    if isinstance(thing, types.FunctionType):
        return "function", [_described(each, known) for each in _read_by(thing)]
    return _of_object(thing, known)


def _of_array(array: np.ndarray, known: dict[int, int]) -> Any:
    """The description of an array."""
    if array.dtype.hasobject:
        return "array", array.shape, [_described(each, known) for each in array.ravel().tolist()]
    return "array", str(array.dtype), array.shape, hashlib.blake2b(array.tobytes(), digest_size=16).hexdigest()


def _read_by(function: types.FunctionType) -> tuple[Any, ...]:
    """The code of a function and the data that it reads besides its arguments."""
    cells = [content(cell) for cell in function.__closure__ or ()]
    if _is_installed(function.__module__):
        return function.__module__, function.__qualname__, cells
    known = function.__globals__
    read = {name: known[name] for name in sorted(names_read(function.__code__)) if name in known}
    return function.__code__, function.__defaults__, function.__kwdefaults__, cells, read


def _of_object(thing: Any, known: dict[int, int]) -> Any:
    """The description of another object: its functions if it is a class, otherwise its class and its attributes."""
    if isinstance(thing, type):
        if _is_installed(thing.__module__):
            return "class", thing.__module__, thing.__qualname__
        own = {name: each for name, each in vars(thing).items() if isinstance(each, types.FunctionType)}
        return "class", thing.__qualname__, [_described(each, known) for each in (own, thing.__bases__)]
    slots = [name for each in type(thing).__mro__ for name in _names(getattr(each, "__slots__", ()))]
    held = {name: getattr(thing, name, None) for name in slots} | getattr(thing, "__dict__", {})
    held = {n: each for n, each in held.items() if not isinstance(getattr(type(thing), n, None), cached_property)}
    words = "" if held else ADDRESS.sub("", repr(thing))  # written in C
    return "object", words, [_described(each, known) for each in (type(thing), held)]


def _names(slots: Any) -> tuple[str, ...]:
    """The names in ``__slots__``, which may be one name."""
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _is_installed(module: str | None) -> bool:
    """True if a module belongs to Python, to one of the known libraries or to an installed package."""
    name = str(module).split(".")[0]
    file = getattr(sys.modules.get(str(module)), "__file__", None) or ""
    return is_of_library(name) or name in sys.stdlib_module_names or file.startswith(INSTALLED)
