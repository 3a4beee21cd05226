"""Find the data that a function reads from outside, to recognise equal functions and to turn numbers into arguments.

A lambda in a loop, or a notebook cell that runs again, makes a new function with the same code. Two functions compute
the same result if they have the same code and this code reads the same data. If functions were compared by identity,
each new one would cost seconds of compilation.

``for mass in masses: solve(Problem(lambda x, u: u / mass, ...), grid)`` would still compile a program for every mass,
because a number that a function closes over is part of its computation. The numbers in cells and globals are therefore
found and passed to a copy of the function as arguments, so they become leaves of the problem. A number stays in the
function if it is used for more than arithmetic: an exponent of 2 makes a cost quadratic in the control, an integer may
be a shape, a comparison with another number may choose between two branches.
"""

from __future__ import annotations

import dataclasses
import dis
import hashlib
import inspect
import re
import sys
import types
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard, cast

import jax
import numpy as np
from jax.tree_util import Partial

from hjbjax.problem.pytree import is_traced
from hjbjax.problem.types import Numbers
from hjbjax.tracing import jaxprs

if TYPE_CHECKING:
    from jax.extend import core as jex

ADDRESS = re.compile(r" at 0x[0-9a-f]+|id=\d+")  # addresses of derivative rules, which differ between traces
CALLBACKS = ("pure_callback", "io_callback")
# libraries whose functions do not change; a problem that only uses these does not have to be traced
LIBRARIES = frozenset({"builtins", "functools", "hjbjax", "itertools", "jax", "jaxlib", "math", "numpy", "operator"})
# operations with a number that do not change the kind of dependence on a state or a control
ARITHMETIC = frozenset({
    "add", "add_any", "sub", "mul", "div", "max", "min", "clamp", "atan2", "dot_general", "concatenate",
    "gt", "ge", "lt", "le",
})  # fmt: skip
CALLED = frozenset({"jit", "pjit"})  # the same primitive in different versions of JAX
INSIDE = "."  # between the name of a function and the name that it reads
FLOATS = (float, np.floating)
NUMBERS = (int, float, np.integer, np.floating)


def identity(thing: object, depth: int = 8) -> Hashable | None:
    """A value that is equal for parts of a problem that compute the same; None if a part reads data from outside.

    It is equal, for example, for a lambda that is created twice, or a helper that is defined twice with the same code.
    """
    if depth == 0:  # functions may call each other recursively; None costs a trace and is always correct
        return None
    # other numbers than leaves cannot change: a Partial keeps its numbers, and a JAX dataclass is frozen or copied
    if thing is None or isinstance(thing, (bool, int, float, str, np.generic, np.ndarray, jax.Array)):
        return "leaf"
    if isinstance(thing, Partial):
        return _identities((thing.func, *thing.args, *thing.keywords.values()), depth)
    if isinstance(thing, (tuple, list)):
        return _identities(thing, depth)
    if isinstance(thing, dict):  # the keywords of a function that the package transforms
        found = _identities(thing.values(), depth)
        return None if found is None else (tuple(thing), found)
    if isinstance(thing, types.FunctionType):
        return _identity_of_function(thing, depth)
    if isinstance(thing, Composite):
        return _identities((thing.function, *thing.inner), depth)
    if dataclasses.is_dataclass(thing) and not jax.tree_util.all_leaves([thing]):
        fields = _identities([getattr(thing, field.name) for field in dataclasses.fields(thing)], depth)
        return None if fields is None else (type(thing), fields)
    return None


def _identities(things: Iterable[object], depth: int) -> Hashable | None:
    """The identities of several parts; None if the identity of any part is None."""
    found = [identity(each, depth - 1) for each in things]
    return None if None in found else tuple(found)


def _identity_of_function(function: types.FunctionType, depth: int) -> Hashable | None:
    """A function's code and the identities of its globals and cells; None if one may change between two solves."""
    cells = [_identity_of_cell(cell, function.__module__, depth) for cell in function.__closure__ or ()]
    if None in cells or function.__kwdefaults__:  # dictionaries are mutable
        return None
    if not all(isinstance(each, (int, float, str, type(None))) for each in function.__defaults__ or ()):
        return None
    # CPython keeps names of globals and attributes in one table; an attribute named like a global costs a trace
    known = function.__globals__
    outside = [known[name] for name in sorted(names_read(function.__code__)) if name in known]
    found = [
        each if _is_library(each) else identity(each, depth - 1) if isinstance(each, types.FunctionType) else None
        for each in outside
    ]
    # compare by repr, since 0.0 equals −0.0 and True equals 1; code objects compare constants by type and bits
    return None if None in found else (function.__code__, repr(function.__defaults__), tuple(found), tuple(cells))


def _identity_of_cell(cell: types.CellType, module: str | None, depth: int) -> Hashable | None:
    """The identity of the content of a cell, a function or a discrete choice; None if it may change, or is a number.

    A user may rebind a cell. The package does not: its closures transform a user's function.
    """
    held = content(cell)
    if (module or "").split(".")[0] != "hjbjax":
        return None
    if held is None or isinstance(held, (bool, int, str)):
        return repr(held)
    return identity(held, depth - 1) if isinstance(held, types.FunctionType) else None


def names_read(code: types.CodeType) -> set[str]:
    """The names of globals and attributes in a piece of code and in the functions defined inside it."""
    inner = (names_read(each) for each in code.co_consts if isinstance(each, types.CodeType))
    return set(code.co_names).union(*inner)


def _is_library(thing: object) -> bool:
    """True if a global is a module, a function or a class of a library, which does not change between two solves."""
    if isinstance(thing, types.ModuleType):
        return is_of_library(thing.__name__)
    home, name = getattr(thing, "__module__", None), getattr(thing, "__name__", None)
    # an object of a library's class, such as functools.partial, may hold anything; its module has no such name
    return is_of_library(home) and thing is getattr(sys.modules.get(home), str(name), None)


def is_of_library(module: object) -> TypeGuard[str]:
    """True if a module belongs to one of ``LIBRARIES``."""
    return isinstance(module, str) and module.split(".")[0] in LIBRARIES


def code(function: Callable) -> object:
    """The code of a function, or the function if it has none: it distinguishes functions with the same jaxpr."""
    return getattr(getattr(function, "__func__", function), "__code__", function)


def fingerprint(jaxpr: jex.Jaxpr, consts: Iterable[Numbers] = ()) -> tuple[tuple[Hashable, ...], bool]:
    """A mark of the computation of a jaxpr, including all its numbers, and True if the mark is complete.

    It is incomplete if the jaxpr has custom derivative rules other than JAX's own, because it does not contain them.
    """
    account = _Account()
    account.take(jaxpr, consts)
    return (account.digest.digest(), *account.callbacks), account.whole


class _Account:
    """A digest of a jaxpr, the host functions that it calls, and True if they describe the whole computation."""

    def __init__(self) -> None:
        self.digest = hashlib.blake2b(digest_size=16)  # two of 10^10 functions share a digest with probability 1e-19
        self.callbacks: list[Hashable] = []
        self.whole = True

    def take(self, jaxpr: jex.Jaxpr, consts: Iterable[Numbers]) -> None:
        """Add a jaxpr to the digest, equation by equation."""
        numbers: dict[Any, int] = {}  # variables by first appearance, since their names differ between traces
        for var in (*jaxpr.constvars, *jaxpr.invars):
            self._tell(numbers.setdefault(var, len(numbers)), str(var.aval))
        for value in consts:
            self._number(value)
        for eqn in (*jaxpr.eqns, None):  # None: the outputs of the jaxpr, treated like the operands of an equation
            operands, results = (jaxpr.outvars, ()) if eqn is None else (eqn.invars, eqn.outvars)
            self._tell("" if eqn is None else eqn.primitive.name)
            for operand in operands:
                if jaxprs.is_literal(operand):  # a number in the code, without a variable
                    self._number(operand.val)
                else:
                    self._tell(numbers.get(operand, -1))
            for result in results:
                self._tell(numbers.setdefault(result, len(numbers)), str(result.aval))
            if eqn is not None:
                self._parameters(eqn.primitive.name, eqn.params)

    def _parameters(self, primitive: str, parameters: dict[str, Any]) -> None:
        if primitive.startswith("custom_") and not _is_rule_of_jax(parameters):
            self.whole = False
        for name in sorted(parameters):
            self._tell(name)
            if primitive in CALLBACKS and name == "callback":
                self.callbacks.append(_called(parameters[name]))
            else:
                self._parameter(parameters[name])

    def _parameter(self, value: object) -> None:
        if jaxprs.is_closed(value):
            self.take(value.jaxpr, value.consts)
        elif jaxprs.is_open_jaxpr(value):
            self.take(value, ())
        elif isinstance(value, (tuple, list)):
            self._tell(len(value))
            for each in value:
                self._parameter(each)
        elif isinstance(value, (np.ndarray, jax.Array)):
            self._number(value)
        else:
            self._tell(ADDRESS.sub("", repr(value)))

    def _number(self, value: Numbers) -> None:
        array, kind = bits_of(value)  # because printing rounds numbers and abridges long arrays
        self._tell(kind, array.shape)
        self.digest.update(array.tobytes())

    def _tell(self, *words: Any) -> None:
        self.digest.update(repr(words).encode())


def bits_of(value: Any) -> tuple[np.ndarray, Any]:
    """An array in NumPy, and its dtype; for random keys their data, which NumPy has no type for."""
    dtype = getattr(value, "dtype", None)
    if dtype is not None and jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key):
        with jax.core.eval_context():  # outside of the caller's ``jit``
            return np.asarray(jax.random.key_data(value)), str(dtype)
    array = np.asarray(value)
    return array, array.dtype


def _is_rule_of_jax(parameters: dict[str, Any]) -> bool:
    """True if a function with a custom derivative rule belongs to JAX, such as relu."""
    inner = parameters.get("call_jaxpr", parameters.get("fun_jaxpr"))
    info = getattr(getattr(inner, "jaxpr", None), "debug_info", None)  # private names, which may change in JAX
    where = re.search(r" at (.*):\d+$", getattr(info, "func_src_info", None) or "")
    return where is not None and Path(where[1]).is_relative_to(Path(jax.__file__).parent)


def _called(callback: object) -> Hashable:
    """An identity of a host function: its code if it reads only globals, otherwise the function."""
    function = getattr(callback, "callback_func", callback)
    if isinstance(function, types.FunctionType) and not (
        function.__closure__ or function.__defaults__ or function.__kwdefaults__
    ):
        return ByCode(function)  # a lambda inside the drift is a new object in every trace
    return function


class ByCode:
    """A host function without a closure; it equals another with the same code and the same globals."""

    def __init__(self, function: types.FunctionType):
        self.function = function

    def _key(self) -> tuple[types.CodeType, int]:
        """The values that ``==`` and ``hash`` compare."""
        return self.function.__code__, id(self.function.__globals__)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByCode) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


class Composite:
    """A function whose leading arguments contain other functions, as a function of the numbers in these arguments.

    ``Partial(negative, Partial(distance, 0.5))`` is a pytree with ``distance`` in its structure, so two of them are
    equal only if ``distance`` is the same object. ``Partial(Composite(negative, distance), ((0.5,), {}))`` is compared
    by its computation, like any other function, and the numbers that ``distance`` reads are found.

    Args:
      function: the outer function.
      structure: the structure of its leading arguments and keywords, in which every inner ``Partial`` is a leaf.
      inner: the function of each of these leaves; None for a leaf that is not a ``Partial``.
    """

    def __init__(self, function: Callable, structure: Any, inner: Sequence[Callable | None]):
        self.function, self.structure, self.inner = function, structure, tuple(inner)
        self.__code__ = tuple(each and code(each) for each in (function, *self.inner))

    def __reduce__(self) -> tuple[type, tuple[Callable, Any, tuple[Callable | None, ...]]]:
        """Pickle the functions, because a code object cannot be pickled."""
        return Composite, (self.function, self.structure, self.inner)

    def __call__(self, leaves: Sequence[Any], *arguments: Any, **options: Any) -> Any:
        """The outer function's result; a leaf with an inner function is a tuple of its arguments and keywords."""
        pairs = zip(self.inner, leaves, strict=True)
        held = [leaf if inner is None else Partial(inner, *leaf[0], **leaf[1]) for inner, leaf in pairs]
        leading, keywords = jax.tree.unflatten(self.structure, held)
        return self.function(*leading, *arguments, **keywords, **options)


def unnested(function: Partial) -> Partial:
    """An equal ``Partial`` whose arguments do not contain another ``Partial``."""
    leaves, structure = jax.tree.flatten((function.args, function.keywords), is_leaf=_is_partial)
    if not any(map(_is_partial, leaves)):
        return function
    flat = [unnested(leaf) if _is_partial(leaf) else leaf for leaf in leaves]
    inner = [each.func if _is_partial(each) else None for each in flat]
    numbers = [(each.args, each.keywords) if _is_partial(each) else each for each in flat]
    return Partial(Composite(function.func, structure, inner), tuple(numbers))


def _is_partial(thing: object) -> TypeGuard[Partial]:
    """True for a ``Partial``: a function with some of its arguments."""
    return isinstance(thing, Partial)


class OfNumbers:
    """A function of its own arguments and of the numbers that it reads under ``names``."""

    def __init__(self, function: Callable, names: Sequence[str]):
        assert isinstance(function, (types.FunctionType, Composite))  # other callables do not read anything by name
        self.function, self.names = function, tuple(names)
        self.__code__ = function.__code__  # distinguishes the function from others, together with its mark
        own = inspect.signature(function)
        first = inspect.Parameter("numbers", inspect.Parameter.POSITIONAL_ONLY)
        self.__signature__ = own.replace(parameters=[first, *own.parameters.values()])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OfNumbers) and (self.function, self.names) == (other.function, other.names)

    def __hash__(self) -> int:
        return hash((self.function, self.names))

    def __reduce__(self) -> tuple[type, tuple[Callable, tuple[str, ...]]]:
        """Pickle the function and the names, because a code object cannot be pickled."""
        return OfNumbers, (self.function, self.names)

    def __call__(self, numbers: tuple, *arguments: Any, **options: Any) -> Any:
        """The function's result if it reads ``numbers``."""
        return _reading(self.function, dict(zip(self.names, numbers, strict=True)))(*arguments, **options)


def _reading(function: Any, numbers: dict[str, Any]) -> Any:
    """A copy of a function, or of a tuple that it reads, with ``numbers`` instead of its own.

    ``helper.name`` is the name in a function that it calls, and ``pair.0`` the first number of a tuple.
    """
    values: dict[str, Any] = {}
    for name, number in numbers.items():
        helper, _, inner = name.partition(INSIDE)
        if inner:
            values.setdefault(helper, {})[inner] = number
        else:
            values[name] = number
    if isinstance(function, tuple):
        return tuple(values.get(str(i), each) for i, each in enumerate(function))
    if isinstance(function, Composite):
        outer, *inside = (_reading(each, values[str(i)]) if str(i) in values else each for i, each in _each(function))
        return Composite(outer, function.structure, inside)
    read = _read(function)
    values = {n: _reading(read[n], each) if isinstance(each, dict) else each for n, each in values.items()}
    inner_names, cells = function.__code__.co_freevars, function.__closure__ or ()
    changed = types.FunctionType(
        function.__code__,
        function.__globals__ | {name: each for name, each in values.items() if name not in inner_names},
        function.__name__,
        function.__defaults__,
        tuple(types.CellType(values[n]) if n in values else c for n, c in zip(inner_names, cells, strict=True)),
    )
    changed.__kwdefaults__ = function.__kwdefaults__
    return changed


def numbers_read(function: Callable, kinds: tuple[type, ...], depth: int = 6) -> dict[str, np.ndarray]:
    """Numbers of these kinds, and real arrays, in the cells and globals that a function's own code names.

    Functions in its cells are included, as ``helper.name``: a drift may call a helper defined next to it. Numbers in
    tuples are included as ``pair.0``; lists are not, because they may change while the function runs. The functions of
    ``Composite`` are called 0, 1, 2 and so on. Rewards and discounts of the state add up to three levels of the
    package's own functions.
    """
    if isinstance(function, Composite):
        each_read = ((i, numbers_read(each, kinds, depth)) for i, each in _each(function))
        return {f"{i}{INSIDE}{name}": number for i, read in each_read for name, number in read.items()}
    if depth == 0 or not isinstance(function, types.FunctionType) or _writes(function.__code__):
        return {}
    read = _read(function)
    found = {name: np.asarray(each, float) for name, each in read.items() if _is_number(each, kinds)}
    for name, thing in read.items():
        members = enumerate(thing) if type(thing) is tuple else ()
        found |= {f"{name}{INSIDE}{i}": np.asarray(each, float) for i, each in members if _is_number(each, kinds)}
    for name in function.__code__.co_freevars:
        inside = numbers_read(read[name], kinds, depth - 1) if isinstance(read[name], types.FunctionType) else {}
        found |= {f"{name}{INSIDE}{each}": number for each, number in inside.items()}
    return dict(sorted(found.items()))


def _each(function: Composite) -> Iterable[tuple[int, Any]]:
    """The outer function and the inner ones, with their numbers."""
    return enumerate((function.function, *function.inner))


def _read(function: types.FunctionType) -> dict[str, Any]:
    """The values of the globals and the cells that a function's own code names.

    A global with the name of an attribute is included too, although the function does not read it; this is harmless.
    """
    found = {name: function.__globals__.get(name) for name in names_read(function.__code__)}
    return found | {
        name: content(cell)
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    }


def _writes(code: types.CodeType) -> bool:
    """True if code rebinds a global or a name of an enclosing function. A copy would not have this effect."""
    for each in dis.get_instructions(code):
        if each.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
            return True
        if each.opname in ("STORE_DEREF", "DELETE_DEREF") and each.argval in code.co_freevars:
            return True
    return any(_writes(each) for each in code.co_consts if isinstance(each, types.CodeType))


def content(cell: types.CellType) -> object:
    """The content of a cell; None if it is empty."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _is_number(thing: object, kinds: tuple[type, ...]) -> bool:
    """True for a number of these kinds, and for a known array of real numbers."""
    if isinstance(thing, (np.ndarray, jax.Array)):
        return not is_traced(thing) and jax.dtypes.issubdtype(thing.dtype, np.floating)
    return isinstance(thing, kinds) and not isinstance(thing, bool)


def decisive(jaxpr: jex.Jaxpr, variables: Sequence[jex.Var], values: Sequence[np.ndarray]) -> set[int]:
    """Positions of the variables that are used for more than arithmetic with the jaxpr's other arguments.

    An exponent is decisive if its value is an integer: in Python code it may be one, for which JAX multiplies.
    """
    whole = frozenset(at for at, value in enumerate(values) if np.all(value == np.round(value)))
    owners = {var: frozenset([position]) for position, var in enumerate(variables)}
    return set(_follow(jaxpr, owners, whole)[0])


def _follow(
    jaxpr: jex.Jaxpr, owners: dict[jex.Var, frozenset[int]], whole: frozenset[int]
) -> tuple[set[int], list[frozenset[int]]]:
    """Positions of the decisive variables, and for each output the positions of the variables it depends on.

    ``owners``: for each variable that is known before any state, the positions it was made from.
    """

    def sources(var: jex.Var | jex.Literal) -> frozenset[int]:
        return frozenset() if jaxprs.is_literal(var) else owners.get(cast("jex.Var", var), frozenset())

    deciding: set[int] = set()
    for eqn in jaxpr.eqns:
        read = [sources(each) for each in eqn.invars]
        touched: frozenset[int] = frozenset().union(*read)
        if touched and all(each or jaxprs.is_literal(var) for each, var in zip(read, eqn.invars, strict=True)):
            owners |= dict.fromkeys(eqn.outvars, touched)  # a number made from numbers
            continue
        name, inner = eqn.primitive.name, eqn.params.get("jaxpr")
        if touched and name in CALLED and jaxprs.is_closed(inner):
            pairs = {mine: each for mine, each in zip(inner.jaxpr.invars, read, strict=True) if each}
            inside, results = _follow(inner.jaxpr, pairs, whole)
            deciding |= inside
            owners |= {var: each for var, each in zip(eqn.outvars, results, strict=True) if each}
        elif name == "select_n":
            deciding |= read[0]  # numbers that choose between two functions of the state
        elif name == "pow":
            deciding |= read[1] & whole
        elif touched and name not in ARITHMETIC:
            deciding |= touched
    return deciding, [sources(each) for each in jaxpr.outvars]
