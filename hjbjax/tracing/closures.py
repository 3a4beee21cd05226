"""What a problem's functions see beside their arguments: numbers of the moment, and numbers that JAX is tracing.

A compiled program belongs to a function, which JAX tells from others by what it is, not by what it computes. A method
of an object whose attribute was changed, or a function that reads a global, would go on giving the answers of its first
trace. So a function that reads anything from outside is traced anew whenever a front door is entered, which takes about
a millisecond, and carries along a mark of what it computes: programs are kept as long as the mark is the same. The
numbers in a problem's leaves are no part of it.

A function that closes over a number under differentiation, as in ``grad(lambda a: solve(Problem(lambda x, u: a * u)))``
hides it from those who look at the leaves of a problem. Here such numbers become leaves.
"""

import dataclasses
import functools
import hashlib
import inspect
import re
import types
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import altered, is_traced

ADDRESS = re.compile(r" at 0x[0-9a-f]+|id=\d+")  # of rules of derivatives, made anew with every trace
LIBRARIES = frozenset({"builtins", "functools", "hjbjax", "itertools", "jax", "jaxlib", "math", "numpy", "operator"})
OF_ACTION = ("drift", "cost", "noise")
OF_STATE = ("target", "exit_cost", "terminal_cost", "stopping_cost", "running_max")


def settled(problem: Problem, n: int, dtype: Any = None) -> Problem:
    """The problem with its functions marked by what they compute now, and traced numbers of closures among its leaves.

    Args:
      problem: the problem.
      n: the number of states.
      dtype: the floating-point type inside a JAX transformation; ``None`` is that of ``float`` there.
    """
    names = [name for name in (*OF_ACTION, *OF_STATE) if callable(getattr(problem, name))]
    fixed = {name: _remembering(getattr(problem, name)) for name in names if _is_fixed(getattr(problem, name))}
    asked = [name for name in names if name not in fixed]
    if not is_traced(problem):
        with jax.core.eval_context(), jax.enable_x64(True):
            found = {name: _traced(problem, name, n, np.dtype(np.float64)) for name in asked}
        if not any(is_traced(closed.consts) for _, closed in found.values() if closed is not None):
            return altered(problem, **fixed, **{name: _marked(*pair) for name, pair in found.items()})
    kind = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    found = {name: _traced(problem, name, n, kind) for name in asked}
    return altered(problem, **fixed, **{name: _opened(*pair) for name, pair in found.items()})


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
            given[first] = _all_settled(given[first], given[second].ndim, given.get("dtype"))
        if is_traced(given):
            return front_door(**given)
        with jax.core.eval_context():
            return front_door(**given)

    return entered


def _all_settled(asked: Any, n: int, dtype: Any) -> Any:
    """A problem, or the problems among some things, settled."""
    if isinstance(asked, Problem):
        return settled(asked, n, dtype)
    if not isinstance(asked, Iterable):
        return asked
    each = list(asked)
    return [settled(one, n, dtype) if isinstance(one, Problem) else one for one in each]


class Marked:
    """A function with a mark of what it computes, which it equals another by, and with the jaxprs of its traces.

    Python runs the function once for every kind of arguments: a solve looks at it in half a dozen places (checks,
    dependence on the control, the chain, slopes of the drift in u), and each would trace it anew.
    """

    def __init__(self, function: Callable, mark: Any = None):
        self.__wrapped__, self.mark = function, mark  # the name under which ``inspect`` finds the signature
        self._jaxprs: dict[Any, tuple[jex.ClosedJaxpr, Any] | None] = {}

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """What the function returns; under a trace by its jaxpr."""
        if not is_traced(arguments, options):
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

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Marked) and self.mark == other.mark and self.__wrapped__ == other.__wrapped__

    def __hash__(self) -> int:
        return hash((self.__wrapped__, self.mark))


class Opened:
    """A traced function of what it closed over, of the leaves it held, and of its arguments."""

    def __init__(self, jaxpr: Any):
        self.jaxpr = jaxpr

    def __call__(self, known: tuple, *arguments: Any) -> Any:
        """What the function returned, with ``known`` the numbers it closed over and its leaves."""
        constants, leaves = known
        closed = self._typed(constants, self.jaxpr.constvars)
        return jax.core.eval_jaxpr(self.jaxpr, closed, *self._typed((*leaves, *arguments), self.jaxpr.invars))[0]

    @staticmethod
    def _typed(values: Any, variables: Any) -> list:
        return [jnp.asarray(value, var.aval.dtype) for value, var in zip(values, variables, strict=True)]


def _kind(leaf: Any) -> tuple[tuple[int, ...], Any, bool]:
    """Shape, type and weakness of a number or of its place holder: what a jaxpr depends on."""
    aval = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    return aval.shape, aval.dtype, bool(aval.weak_type)


def _opened(function: jax.tree_util.Partial, closed: jex.ClosedJaxpr | None) -> jax.tree_util.Partial:
    """A function inside a JAX transformation: with a mark, or with what it closed over as leaves."""
    if closed is None or not is_traced(closed.consts):
        return _marked(function, closed)
    leaves = jax.tree.leaves((function.keywords, function.args))
    return jax.tree_util.Partial(Opened(closed.jaxpr), (tuple(closed.consts), leaves))


def _is_fixed(thing: Any, depth: int = 8) -> bool:
    """Whether a part of a problem reads nothing from outside but library code, so that it never computes otherwise."""
    if depth == 0:
        return False
    if thing is None or isinstance(thing, (bool, int, float, str, np.generic, np.ndarray, jax.Array)):
        return True  # the arrays are leaves
    if isinstance(thing, jax.tree_util.Partial):
        return all(_is_fixed(each, depth - 1) for each in (thing.func, *thing.args, *thing.keywords.values()))
    if isinstance(thing, (tuple, list)):
        return all(_is_fixed(each, depth - 1) for each in thing)
    if isinstance(thing, types.FunctionType):
        return _reads_no_variables(thing, depth - 1)
    if dataclasses.is_dataclass(thing) and not jax.tree_util.all_leaves([thing]):
        return all(_is_fixed(getattr(thing, field.name), depth - 1) for field in dataclasses.fields(thing))
    return False


def _reads_no_variables(function: types.FunctionType, depth: int) -> bool:
    """Whether a function's globals are library code, or functions of which that is true."""
    if function.__closure__ or function.__kwdefaults__:
        return False
    if not all(isinstance(each, (int, float, str, type(None))) for each in function.__defaults__ or ()):
        return False
    known = function.__globals__
    outside = [known[name] for name in _names(function.__code__) if name in known]
    return all(
        _is_library(each) or (isinstance(each, types.FunctionType) and _is_fixed(each, depth)) for each in outside
    )


def _names(code: types.CodeType) -> set[str]:
    """The names of globals, and of attributes, in a piece of code and in what is defined inside it."""
    inner = (_names(each) for each in code.co_consts if isinstance(each, types.CodeType))
    return set(code.co_names).union(*inner)


def _is_library(thing: Any) -> bool:
    """Whether a global is a module, a function or a class of a library that nobody changes between two solves."""
    home = thing.__name__ if isinstance(thing, types.ModuleType) else getattr(thing, "__module__", None)
    fixed = isinstance(thing, types.ModuleType) or callable(thing)
    return fixed and isinstance(home, str) and home.split(".")[0] in LIBRARIES


def _remembering(function: jax.tree_util.Partial) -> jax.tree_util.Partial:
    """The function with a memory for its jaxprs, and no mark yet."""
    inner = function.func.__wrapped__ if isinstance(function.func, Marked) else function.func
    return jax.tree_util.Partial(Marked(inner), *function.args, **function.keywords)


def _traced(problem: Problem, name: str, n: int, dtype: Any) -> tuple[jax.tree_util.Partial, jex.ClosedJaxpr | None]:
    """A function and its jaxpr in leaves and arguments; None where it cannot be traced: the checks will say why."""
    function = _remembering(getattr(problem, name))
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


def _marked(function: jax.tree_util.Partial, closed: jex.ClosedJaxpr | None) -> jax.tree_util.Partial:
    """The function with the mark of its trace; where there is none it equals no other."""
    assert isinstance(function.func, Marked)
    function.func.mark = object() if closed is None else fingerprint(closed)
    return function


def fingerprint(closed: jex.ClosedJaxpr) -> bytes:
    """A digest of what a jaxpr computes, with every number that it holds."""
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest, closed.jaxpr, closed.consts)
    return digest.digest()


def _feed(digest: Any, jaxpr: Any, consts: Iterable[Any]) -> None:
    numbers: dict[Any, int] = {}

    def tell(*words: Any) -> None:
        digest.update(repr(words).encode())

    def number(value: Any) -> None:
        array = np.asarray(value)
        tell(array.dtype, array.shape)
        digest.update(array.tobytes())

    def tell_parameter(value: Any) -> None:
        if isinstance(value, jex.ClosedJaxpr):
            _feed(digest, value.jaxpr, value.consts)
        elif isinstance(value, jex.Jaxpr):
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
    for eqn in (*jaxpr.eqns, None):
        operands, results = (jaxpr.outvars, ()) if eqn is None else (eqn.invars, eqn.outvars)
        tell("" if eqn is None else eqn.primitive.name)
        for operand in operands:
            if isinstance(operand, jex.Literal):
                number(operand.val)
            else:
                tell(numbers.get(operand, -1))
        for result in results:
            tell(numbers.setdefault(result, len(numbers)), str(result.aval))
        for name in sorted(eqn.params) if eqn is not None else ():
            tell(name)
            tell_parameter(eqn.params[name])
