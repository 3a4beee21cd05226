"""Digests of Python objects for checkpoints: the same in every process, and different for different data.

A jaxpr contains a host function as an object, and a run has a method and a scheme, which a user may have written. A run
that is resumed in another process has other objects, so they are described by their code and by everything that it
reads: defaults, closures, globals, attributes of objects, classes and modules, and the functions that it calls. Arrays
are described by their bytes, because printing rounds and abridges them. Code of installed packages is described by its
name.

A jaxpr does not contain the custom derivative rules of its functions either. They are described by the operations of
the derivatives.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import sys
import sysconfig
import types
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.pytree import is_traced
from hjbjax.tracing import jaxprs
from hjbjax.tracing.outside import ADDRESS, ByCode, bits_of, content, fingerprint, is_of_library, names_read

if TYPE_CHECKING:
    from jax.extend import core as jex

ORDERS = 3  # of derivatives whose rules are described: a training differentiates a minimiser with second derivatives
PLAIN = (type(None), bool, int, float, complex, str, bytes)
INSTALLED = tuple(sysconfig.get_path(name) for name in ("purelib", "platlib"))


def digest_of(thing: object) -> str:
    """A digest of an object, also of a host function as ``outside.fingerprint`` lists it."""
    return _hash(_described(thing, {}))


def digest_of_jaxpr(closed: jex.ClosedJaxpr, orders: int = ORDERS) -> str:
    """A digest of the operations and constants of a jaxpr, of its host functions, and of its derivative rules.

    Args:
      closed: the jaxpr.
      orders: the number of times that its function may be differentiated; zero if it is only evaluated.
    """
    return _hash(_of_program(closed.jaxpr, closed.consts, {}, orders))


def _hash(description: Any) -> str:
    return hashlib.blake2b(repr(description).encode(), digest_size=16).hexdigest()


def _described(thing: Any, known: dict[int, tuple[int, Any]]) -> Any:
    """Nested tuples of text for an object.

    ``known`` has the objects that have been described by their addresses, each with its number. It keeps them, because
    another object may get the address of one that is gone.
    """
    if isinstance(thing, ByCode):
        thing = thing.function
    if isinstance(thing, PLAIN):
        return repr(thing)
    if isinstance(thing, jax.Array) and is_traced(thing):  # the host cannot read it, but may use its shape
        return "traced", str(thing.aval)
    if isinstance(thing, (np.ndarray, np.generic, jax.Array)):
        return _of_array(*bits_of(thing), known)
    if jaxprs.is_closed(thing):
        return _of_program(thing.jaxpr, thing.consts, known)
    if jaxprs.is_open_jaxpr(thing):  # its constants are stored elsewhere, and described there
        return _of_program(thing, (), known)
    if isinstance(thing, jax.tree_util.PyTreeDef):  # printing it omits the data of the functions in it
        return "tree", [_described(each, known) for each in (thing.node_data(), thing.children())]
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
    if isinstance(thing, _Reading):
        return "module", thing.module.__name__, _described(thing.attributes(), known)
    if isinstance(thing, (staticmethod, classmethod)):
        return type(thing).__name__, _described(thing.__func__, known)
    if isinstance(thing, property):
        return "property", [_described(each, known) for each in (thing.fget, thing.fset, thing.fdel)]
    if id(thing) in known:  # functions may call each other, and objects may hold each other
        return "again", known[id(thing)][0]
    known[id(thing)] = len(known), thing
    if isinstance(thing, functools.partial):
        return "partial", [_described(each, known) for each in (thing.func, thing.args, thing.keywords)]
    if isinstance(thing, types.FunctionType):
        return "function", [_described(each, known) for each in _read_by(thing)]
    return _of_object(thing, known)


def _of_array(array: np.ndarray, dtype: Any, known: dict[int, tuple[int, Any]]) -> Any:
    """The description of an array, whose dtype is another one if it is the data of random keys."""
    if array.dtype.hasobject:
        return "array", array.shape, [_described(each, known) for each in array.ravel().tolist()]
    return "array", str(dtype), array.shape, hashlib.blake2b(array.tobytes(), digest_size=16).hexdigest()


@dataclasses.dataclass(frozen=True)
class _Reading:
    """A module of the user, and the names of the attributes that a function may read from it."""

    module: types.ModuleType
    names: frozenset[str]

    def attributes(self) -> dict[str, Any]:
        """The attributes of the module with these names; a module in it has the other names."""
        own = vars(self.module)
        return {name: _as_read(own[name], self.names - {name}) for name in sorted(self.names) if name in own}


def _as_read(thing: Any, names: frozenset[str]) -> Any:
    """A module of the user with the attributes of these names; another object unchanged."""
    own = isinstance(thing, types.ModuleType) and not _is_installed(thing.__name__)
    return _Reading(thing, names) if own else thing


def _read_by(function: types.FunctionType) -> tuple[Any, ...]:
    """The code of a function and the data that it reads besides its arguments."""
    cells = [content(cell) for cell in function.__closure__ or ()]
    known = function.__globals__
    if _is_installed(known.get("__name__")):  # ``functools.wraps`` copies ``__module__`` from another function
        return function.__module__, function.__qualname__, cells
    names = frozenset(names_read(function.__code__))
    read = {name: _as_read(known[name], names) for name in sorted(names) if name in known}
    cells = [_as_read(each, names) for each in cells]
    return function.__code__, function.__defaults__, function.__kwdefaults__, cells, read


def _of_object(thing: Any, known: dict[int, tuple[int, Any]]) -> Any:
    """The description of another object: the attributes of a class, otherwise its class and its attributes."""
    if isinstance(thing, type):
        if _is_installed(thing.__module__):
            return "class", thing.__module__, thing.__qualname__
        # of the other attributes with such names Python makes most, such as the documentation and the annotations
        own = {n: each for n, each in vars(thing).items() if n[:2] != "__" or isinstance(each, types.FunctionType)}
        return "class", thing.__qualname__, [_described(each, known) for each in (own, thing.__bases__)]
    if type(thing).__reduce__ is not object.__reduce__ and (kept := _kept_by_pickle(thing)) is not None:
        return "object", _described(kept, known)
    slots = [name for each in type(thing).__mro__ for name in _names(getattr(each, "__slots__", ()))]
    held = {name: getattr(thing, name, None) for name in slots} | getattr(thing, "__dict__", {})
    held = {n: each for n, each in held.items() if not isinstance(getattr(type(thing), n, None), cached_property)}
    words = "" if held else ADDRESS.sub("", repr(thing))  # written in C
    return "object", words, [_described(each, known) for each in (type(thing), held)]


def _kept_by_pickle(thing: Any) -> Any:
    """The data from which a copy is made: without caches, also of an object written in C; None if unknown."""
    try:
        found = thing.__reduce__()
    except Exception:  # any type, from code of others
        return None
    return found if isinstance(found, tuple) else None  # otherwise a name, as of a function with ``lru_cache``


def _of_program(
    jaxpr: jex.Jaxpr, consts: Sequence[Any], known: dict[int, tuple[int, Any]], orders: int = ORDERS
) -> Any:
    """The description of a jaxpr, and of its derivatives up to an order if it has custom rules for them."""
    (numbers, *called), whole = fingerprint(jaxpr, consts)
    found = "program", numbers, [_described(each, known) for each in called]
    if whole or orders == 0:
        return found
    slopes = [_traced(each, jaxpr) for each in (_pullback, _pushforward)]  # a rule may have only one of them
    return *found, [each and _of_program(each.jaxpr, each.consts, known, orders - 1) for each in slopes]


def _traced(derivative: Callable, jaxpr: jex.Jaxpr) -> jex.ClosedJaxpr | None:
    """The program of a derivative of a jaxpr; None if there is none."""
    count = len(jaxpr.constvars)

    def function(*numbers: Any) -> list[Any]:
        return jax.core.eval_jaxpr(jaxpr, numbers[:count], *numbers[count:])

    avals = [jaxprs.array_type(var) for var in (*jaxpr.constvars, *jaxpr.invars)]
    shapes = [jax.ShapeDtypeStruct(each.shape, each.dtype, weak_type=each.weak_type) for each in avals]
    try:
        return jax.make_jaxpr(functools.partial(derivative, function))(*shapes)
    except Exception:  # any type, from rules of others
        return None


def _of_reals(function: Callable, arguments: tuple[Any, ...]) -> tuple[Callable, list[Any]]:
    """The real results of a function of its real arguments, and these arguments."""
    real = [i for i, each in enumerate(arguments) if _is_real(each)]

    def restricted(numbers: list[Any]) -> list[Any]:
        whole = list(arguments)
        for i, number in zip(real, numbers, strict=True):
            whole[i] = number
        return [each for each in function(*whole) if _is_real(each)]

    return restricted, [arguments[i] for i in real]


def _is_real(number: Any) -> bool:
    return jnp.issubdtype(number.dtype, jnp.floating)


def _pullback(function: Callable, *arguments: Any) -> Any:
    """The reverse derivative along the results themselves."""
    results, pull = jax.vjp(*_of_reals(function, arguments))
    return pull(results)


def _pushforward(function: Callable, *arguments: Any) -> Any:
    """The forward derivative along the arguments themselves."""
    restricted, numbers = _of_reals(function, arguments)
    return jax.jvp(restricted, (numbers,), (numbers,))[1]


def _names(slots: Any) -> tuple[str, ...]:
    """The names in ``__slots__``, which may be one name."""
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _is_installed(module: str | None) -> bool:
    """True if a module belongs to Python, to one of the known libraries or to an installed package."""
    name = str(module).split(".")[0]
    file = getattr(sys.modules.get(str(module)), "__file__", None) or ""
    return is_of_library(name) or name in sys.stdlib_module_names or file.startswith(INSTALLED)
