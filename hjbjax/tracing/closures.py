"""What a problem's functions see beside their arguments: numbers of the moment, and numbers that JAX is tracing.

A compiled program belongs to a function, which JAX tells from others by what it is, not by what it computes. A method
of an object whose attribute was changed, or a function that reads a global, would go on giving the answers of its first
trace. So a function that reads anything from outside is traced anew whenever a front door is entered, which takes about
a millisecond, and carries along a mark of what it computes: programs are kept as long as the mark is the same. The
numbers in a problem's leaves are no part of it.

A function that closes over a number under differentiation, as in ``grad(lambda a: solve(Problem(lambda x, u: a * u)))``
hides it from those who look at the leaves of a problem. Here such numbers become leaves.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import re
import types
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, is_traced
from hjbjax.problem.types import DType, Numbers
from hjbjax.tracing import jaxprs

if TYPE_CHECKING:
    from jax.extend import core as jex

ADDRESS = re.compile(r" at 0x[0-9a-f]+|id=\d+")  # of rules of derivatives, made anew with every trace
# whose functions compute tomorrow what they compute today: problems made of these alone need no trace at all
LIBRARIES = frozenset({"builtins", "functools", "hjbjax", "itertools", "jax", "jaxlib", "math", "numpy", "operator"})
OF_ACTION = ("drift", "cost", "noise")
OF_STATE = ("target", "exit_cost", "terminal_cost", "stopping_cost", "running_max")


def settled(problem: Problem, n: int, dtype: DType | None = None) -> Problem:
    """The problem with its functions marked by what they compute now, and traced numbers of closures among its leaves.

    Args:
      problem: the problem.
      n: the number of states.
      dtype: the floating-point type inside a JAX transformation; ``None`` is that of ``float`` there.
    """
    names = [name for name in (*OF_ACTION, *OF_STATE) if callable(getattr(problem, name))]
    # library code computes tomorrow what it computes today and needs no mark; a trace takes about a millisecond
    fixed = {name: _with_memory(getattr(problem, name)) for name in names if _is_fixed(getattr(problem, name))}
    asked = [name for name in names if name not in fixed]
    if not is_traced(problem):
        # outside of the caller's ``jit`` and always in float64: every front door finds one mark for one function
        with jax.core.eval_context(), jax.enable_x64(True):
            found = {name: _trace(problem, name, n, np.dtype(np.float64)) for name in asked}
        if not any(is_traced(closed.consts) for _, closed in found.values() if closed is not None):
            return altered(problem, **fixed, **{name: _with_mark(*pair) for name, pair in found.items()})
    # tracers belong to the caller's transformation, so that these functions are traced inside it, in its type
    kind = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    found = {name: _trace(problem, name, n, kind) for name in asked}
    return altered(problem, **fixed, **{name: _with_closure_as_leaves(*pair) for name, pair in found.items()})


def opened(function: Any, *arguments: jax.ShapeDtypeStruct) -> Any:
    """A function of some arguments with the tracers that it closed over among its leaves; else as it is."""
    if function is None:
        return None
    traced = _with_memory(function)
    assert isinstance(traced.func, Marked)
    found = traced.func.jaxpr(traced.keywords, (*traced.args, *arguments))
    return function if found is None or not is_traced(found[0].consts) else _with_closure_as_leaves(traced, found[0])


def holds_tracers(thing: object, depth: int = 4) -> bool:
    """True if a function closed over a tracer, itself or by a function that it closed over."""
    if isinstance(thing, Partial):
        thing = thing.func
    if depth == 0 or not isinstance(thing, types.FunctionType):
        return is_traced(thing)
    return any(holds_tracers(cell.cell_contents, depth - 1) for cell in thing.__closure__ or ())


def with_settled_functions(front_door: Callable) -> Callable:
    """Decorator of a function of (problem or problems, grid, ...): with the problems settled, and outside of traces.

    A problem of known numbers inside somebody's ``jit`` is solved at once, like any other.
    """

    parameters = inspect.signature(front_door).parameters.values()
    names = [each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
    first, second = names[:2]

    @functools.wraps(front_door)
    def entered(*arguments: Any, **options: Any) -> Any:
        positions = dict(zip(names, arguments, strict=False))
        if len(arguments) > len(names) or positions.keys() & options.keys():
            return front_door(*arguments, **options)  # which Python refuses
        given = positions | options
        if isinstance(given.get(second), Grid) and first in given:
            given[first] = _settle_all(given[first], given[second].ndim, given.get("dtype"))
        if is_traced(given):
            return front_door(**given)
        # inside somebody's ``jit`` a problem of known numbers is still solved on the host, chunk by chunk
        with jax.core.eval_context():
            return front_door(**given)

    return entered


def _settle_all(asked: object, n: int, dtype: DType | None) -> object:
    """A problem, or the problems among several things, settled; the front door refuses everything else."""
    if isinstance(asked, Problem):
        return settled(asked, n, dtype)
    if not isinstance(asked, Iterable):
        return asked
    each = list(asked)  # once: it may be a generator
    return [settled(one, n, dtype) if isinstance(one, Problem) else one for one in each]


class Marked:
    """A function with a mark of what it computes, which it equals another by, and with the jaxprs of its traces.

    Python runs the function once for every kind of arguments: a solve looks at it in half a dozen places (checks,
    dependence on the control, the chain, slopes of the drift in u), and each would trace it anew.
    """

    def __init__(self, function: Callable, mark: object = None):
        self.__wrapped__, self.mark = function, mark  # the name under which ``inspect`` finds the signature
        # a key holds x64 as well, under which constants made inside the function have another type
        self._jaxprs: dict[object, tuple[jex.ClosedJaxpr, Any] | None] = {}

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """What the function returns; under a trace by its jaxpr."""
        if not is_traced(arguments, options):  # on the host a number may be compared, which no jaxpr can
            return self.__wrapped__(*arguments, **options)
        found = self.jaxpr(options, arguments)
        if found is None:
            return self.__wrapped__(*arguments, **options)
        closed, structure = found
        leaves = jax.tree.leaves((options, arguments))
        return jax.tree.unflatten(structure, jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *leaves))

    def jaxpr(self, options: dict, arguments: tuple) -> tuple[jex.ClosedJaxpr, Any] | None:
        """The jaxpr of the leaves of (options, arguments) and the tree of its results; None where there is none.

        There is none where the function cannot be traced for all numbers, so that the reason shows where it is called.
        """
        leaves, structure = jax.tree.flatten((options, arguments))
        kinds = tuple(map(_kind, leaves))
        key = (structure, kinds, jax.config.jax_enable_x64)  # type: ignore[attr-defined]
        if key in self._jaxprs:
            return self._jaxprs[key]

        def of_leaves(*leaves: Any) -> Any:
            options, arguments = jax.tree.unflatten(structure, leaves)
            return self.__wrapped__(*arguments, **options)

        shapes = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in kinds]
        try:
            closed, results = jax.make_jaxpr(of_leaves, return_shape=True)(*shapes)
        except Exception:
            self._jaxprs[key] = None
            return None
        found = closed, jax.tree.structure(results)
        if not is_traced(closed.consts):  # else it belongs to one transformation, which ends
            self._jaxprs[key] = found
        return found

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Marked) and self.mark == other.mark and self.__wrapped__ == other.__wrapped__

    def __hash__(self) -> int:
        return hash((self.__wrapped__, self.mark))


class Opened:
    """A traced function of what it closed over, of the leaves it held, and of its arguments."""

    def __init__(self, jaxpr: jex.Jaxpr):
        self.jaxpr = jaxpr

    def __call__(self, known: tuple, *arguments: Any) -> Any:
        """The function's result, with ``known`` the numbers it closed over and its leaves."""
        constants, leaves = known
        # a jaxpr wants the dtypes it was traced with, and a solve may have cast the leaves to float32 meanwhile
        closed = self._in_traced_dtypes(constants, self.jaxpr.constvars)
        return jax.core.eval_jaxpr(
            self.jaxpr, closed, *self._in_traced_dtypes((*leaves, *arguments), self.jaxpr.invars)
        )[0]

    @staticmethod
    def _in_traced_dtypes(values: Iterable[Numbers], variables: Sequence[jex.Var]) -> list[jax.Array]:
        """Numbers in the dtypes of variables."""
        return [
            jnp.asarray(value, cast(jax.core.ShapedArray, var.aval).dtype)
            for value, var in zip(values, variables, strict=True)
        ]


def _kind(leaf: jax.typing.ArrayLike | jax.ShapeDtypeStruct) -> tuple[tuple[int, ...], Any, bool]:
    """Shape, type and weakness of a number or of its place holder: what a jaxpr depends on."""
    aval = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    return aval.shape, aval.dtype, bool(aval.weak_type)


def _with_closure_as_leaves(function: Partial, closed: jex.ClosedJaxpr | None) -> Partial:
    """A function inside a JAX transformation: with a mark, or with what it closed over as leaves."""
    if closed is None or not is_traced(closed.consts):
        return _with_mark(function, closed)
    leaves = jax.tree.leaves((function.keywords, function.args))
    return Partial(Opened(closed.jaxpr), (tuple(closed.consts), leaves))


def _is_fixed(thing: object, depth: int = 8) -> bool:
    """True if a part of a problem reads nothing from outside but library code, so that it never computes otherwise."""
    if depth == 0:  # functions that call each other have no end; False costs a trace and is never wrong
        return False
    # numbers beside the leaves cannot change: a Partial keeps its own, and a dataclass of JAX's is frozen or copied
    if thing is None or isinstance(thing, (bool, int, float, str, np.generic, np.ndarray, jax.Array)):
        return True  # the arrays are leaves
    if isinstance(thing, Partial):
        return all(_is_fixed(each, depth - 1) for each in (thing.func, *thing.args, *thing.keywords.values()))
    if isinstance(thing, (tuple, list)):
        return all(_is_fixed(each, depth - 1) for each in thing)
    if isinstance(thing, types.FunctionType):
        return _reads_no_variables(thing, depth - 1)
    if dataclasses.is_dataclass(thing) and not jax.tree_util.all_leaves([thing]):
        return all(_is_fixed(getattr(thing, field.name), depth - 1) for field in dataclasses.fields(thing))
    return False


def _reads_no_variables(function: types.FunctionType, depth: int) -> bool:
    """True if a function's globals are library code, or functions of which that is true."""
    if function.__closure__ or function.__kwdefaults__:  # cells can be rebound, and dictionaries written to
        return False
    if not all(isinstance(each, (int, float, str, type(None))) for each in function.__defaults__ or ()):
        return False
    # CPython keeps names of globals and of attributes in one table; an attribute that is also a global costs a trace
    known = function.__globals__
    outside = [known[name] for name in _names(function.__code__) if name in known]
    return all(
        _is_library(each) or (isinstance(each, types.FunctionType) and _is_fixed(each, depth)) for each in outside
    )


def _names(code: types.CodeType) -> set[str]:
    """The names of globals, and of attributes, in a piece of code and in the functions defined inside it."""
    inner = (_names(each) for each in code.co_consts if isinstance(each, types.CodeType))
    return set(code.co_names).union(*inner)


def _is_library(thing: object) -> bool:
    """True if a global is a module, a function or a class of a library that nobody changes between two solves."""
    home = thing.__name__ if isinstance(thing, types.ModuleType) else getattr(thing, "__module__", None)
    fixed = isinstance(thing, types.ModuleType) or callable(thing)
    return fixed and isinstance(home, str) and home.split(".")[0] in LIBRARIES


def _with_memory(function: Partial) -> Partial:
    """The function with a memory for its jaxprs, and no mark yet."""
    inner = function.func.__wrapped__ if isinstance(function.func, Marked) else function.func
    return Partial(Marked(inner), *function.args, **function.keywords)


def _trace(problem: Problem, name: str, n: int, dtype: DType) -> tuple[Partial, jex.ClosedJaxpr | None]:
    """A function and its jaxpr in leaves and arguments; None where it cannot be traced: the checks will say why."""
    function = _with_memory(getattr(problem, name))
    sizes = {
        letter: 0 if admissible is None else admissible.dim
        for letter, admissible in (("u", problem.controls), ("d", problem.disturbances))
    }
    shapes = {"x": (n,), "u": (sizes["u"],), "d": (sizes["d"],), "t": ()}
    letters = problem.arguments("x", "u", "d", "t") if name in OF_ACTION else problem.state_arguments("x", "t")
    arguments = [jax.ShapeDtypeStruct(shapes[letter], dtype) for letter in letters]
    assert isinstance(function.func, Marked)
    found = function.func.jaxpr(function.keywords, (*function.args, *arguments))
    return function, None if found is None else found[0]


def _with_mark(function: Partial, closed: jex.ClosedJaxpr | None) -> Partial:
    """The function with the mark of its trace; where there is none it equals no other."""
    assert isinstance(function.func, Marked)
    function.func.mark = object() if closed is None else fingerprint(closed)
    return function


def fingerprint(closed: jex.ClosedJaxpr) -> bytes:
    """A digest of what a jaxpr computes, with every number that it holds."""
    digest = hashlib.blake2b(digest_size=16)  # by chance two of 10^10 functions share 128 bits once in 10^18 cases
    _feed(digest, closed.jaxpr, closed.consts)
    return digest.digest()


def _feed(digest: hashlib.blake2b, jaxpr: jex.Jaxpr, consts: Iterable[Numbers]) -> None:
    """Put a jaxpr into a digest, equation by equation."""
    numbers: dict[Any, int] = {}  # variables by their first appearance; their own names differ from trace to trace

    def tell(*words: Any) -> None:
        digest.update(repr(words).encode())

    def number(value: Numbers) -> None:
        array = np.asarray(value)  # its bits, since a printed one is rounded and a long one abridged
        tell(array.dtype, array.shape)
        digest.update(array.tobytes())

    def tell_parameter(value: object) -> None:
        if jaxprs.is_closed(value):
            _feed(digest, value.jaxpr, value.consts)
        elif jaxprs.is_open(value):
            _feed(digest, value, ())
        elif isinstance(value, (tuple, list)):
            tell(len(value))
            for each in value:
                tell_parameter(each)
        elif isinstance(value, (np.ndarray, jax.Array)):
            number(value)
        else:
            tell(ADDRESS.sub("", repr(value)))

    for var in (*jaxpr.constvars, *jaxpr.invars):
        tell(numbers.setdefault(var, len(numbers)), str(var.aval))
    for value in consts:
        number(value)
    for eqn in (*jaxpr.eqns, None):  # None: the outputs of the whole, as if an equation took them
        operands, results = (jaxpr.outvars, ()) if eqn is None else (eqn.invars, eqn.outvars)
        tell("" if eqn is None else eqn.primitive.name)
        for operand in operands:
            if jaxprs.is_literal(operand):  # a number in the code, of which no variable tells
                number(operand.val)
            else:
                tell(numbers.get(operand, -1))
        for result in results:
            tell(numbers.setdefault(result, len(numbers)), str(result.aval))
        parameters = {} if eqn is None else eqn.params
        for name in sorted(parameters):
            tell(name)
            tell_parameter(parameters[name])
