"""Checks of a problem on one state, and of a grid, before a solve starts; on the host, never under a tracer.

Every function of the problem is traced once and nothing is allocated. Messages name the fault and the remedy.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.problem import sets
from hjbjax.problem.arguments import as_mesh, check_count, check_parts
from hjbjax.problem.ends import KINDS
from hjbjax.problem.grid import Grid
from hjbjax.problem.mode_axis import refuse_modes
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_partial, remembered
from hjbjax.problem.settings import own_settings
from hjbjax.tracing import indices, jaxprs
from hjbjax.tracing.operations import Operations, operations

OF_ACTION = ("drift", "cost", "noise", "growth", "mode_rates", "intensities", "landings")
STATE_COSTS = ("exit_cost", "terminal_cost", "stopping_cost", "running_max")
RATES = ("discount", "killing")
USERS_NAMES = {
    "killing": "discount", "mode_rates": "Modes.rates", "switching_costs": "Modes.switching_cost",
    "intensities": "Jump.rate", "landings": "Jump.landing",
    "push_costs": "Push.cost",
}  # fmt: skip

_ADVICE = (  # most specific first, since TracerBoolConversionError is a ConcretizationTypeError
    (
        (jax.errors.TracerBoolConversionError, jax.errors.NonConcreteBooleanIndexError),
        "decides by Python `if`, `and`, `min`, `max` or a mask on a traced value: use jnp.where (jnp.minimum, ...)",
    ),
    (jax.errors.TracerArrayConversionError, "passes a traced value to NumPy: use jnp instead of np"),
    (jax.errors.TracerIntegerConversionError, "indexes by a traced value: use jnp.asarray(table)[i]"),
    (
        jax.errors.ConcretizationTypeError,
        "needs a traced value as a number: use jnp instead of np, math, float() and int(), and jnp.where for `if`",
    ),
)

_SLIPS = (  # common mistakes with shapes: JAX's words, and the most likely reason
    ("annot stack arrays", "u and d are arrays, even with a single entry: u[0] is the number"),
    ("must have the same shape", "u and d are arrays, even with a single entry: u[0] is the number"),
    ("Too many indices", "x is one state, without an axis for a batch: x[0] is its first entry"),
    ("setting an array element", "nothing traced can be written into a NumPy array: use jnp.stack([...])"),
)


def cure(error: Exception) -> str | None:
    """The reason why JAX cannot trace a function, and the remedy; ``None`` for errors of another kind."""
    return next((advice for kind, advice in _ADVICE if isinstance(error, kind)), None)


def shapes(problem: Problem, grid: Grid, scheme: Any) -> None:
    """Refuse functions that cannot be traced on one state or return the wrong kind of result.

    Args:
      problem: the problem.
      grid: the grid; only its number of axes and points is used.
      scheme: the scheme; every axis needs at least ``scheme.points`` points.

    Raises:
      ValueError: a result of the wrong shape or kind, a wrong number of arguments, code that JAX cannot trace.
    """
    needed = scheme.points
    for axis in grid.state_axes:
        count = grid.shape[axis]
        if count < needed:
            raise ValueError(f"axis {axis} has {count} points; {type(scheme).__name__} needs at least {needed}")
    n = grid.ndim
    of_one_state(problem, n, "the number of axes of the grid")
    if problem.noise is not None:
        # σ of shape (n, k), with transitions along diagonals
        with own_settings(x64=True):
            if len(_shape_or_fault(problem, "noise", n)) == 2:
                refuse_stretched(grid)


def refuse_prescribed(grid: Grid, name: str, why: str) -> None:
    """Refuse prescribed ends in a function that does not support them, with the reason.

    Raises:
      ValueError: the grid has prescribed ends.
    """
    found = sorted({type(end).__name__ for _, _, end in grid.prescribed()})
    if found:
        raise ValueError(f"{name}: got a grid with {' and '.join(found)} ends, {why}; use edges='projected'")


def check_indices(grid: Grid) -> None:
    """Refuse a grid that no solve can use, before anything of the size of the grid is allocated or compiled.

    Raises:
      MemoryError: more nodes than 32-bit indices can number; the message has the largest possible N.
      ValueError: prescribed ends without their numbers, as on a grid from a file.
    """
    check_count(grid.shape)
    known = {(axis, step) for axis, step, _ in grid.prescribed()}
    if missing := {side for kind in KINDS for side in grid.sides(kind)} - known:
        axis, step = min(missing)
        raise ValueError(
            f"Grid.edges: the {'upper' if step > 0 else 'lower'} end of {grid.names[axis]} is prescribed, but its "
            "numbers are unknown, because files do not store them. Make the Grid again with hjb.Dirichlet(value), "
            "hjb.Neumann(slope) or hjb.Robin(rate)"
        )


def refuse_stretched(grid: Grid) -> None:
    """Refuse correlated noise, σ of shape (n, k), on a stretched grid: diagonal jumps require equal spacings."""
    if grid.ndim > 1 and any(each is not None for each in grid.stretch):
        raise ValueError(
            "noise: correlated noise, σ of shape (n, k), requires equal spacings: leave out Grid.stretch, or give "
            "noise by axis, (n,)"
        )


def of_one_state(problem: Problem, n: int, meaning: str) -> None:
    """Refuse functions that cannot be traced on a state of ``n`` numbers or return the wrong kind of result.

    Args:
      problem: the problem.
      n: the number of states.
      meaning: the meaning of n, for messages.

    Raises:
      ValueError: as for ``shapes``.
    """

    refuse_modes(problem)

    def expect(name: str, wanted: str, fits: Callable[[tuple], bool]) -> None:
        _expect(problem, name, n, wanted, fits, "a scalar" if wanted == "()" else f"n = {n} is {meaning}")

    # results are cached, so they must not depend on the precision that JAX is set to at the first call
    with own_settings(x64=True):
        expect("drift", f"({n},)", lambda shape: shape == (n,))
        expect("noise", f"(), ({n},) or ({n}, k)", lambda shape: shape[:1] in ((), (n,)) and len(shape) <= 2)
        for name in ("cost", "growth", "target", *STATE_COSTS, *RATES):
            expect(name, "()", lambda shape: shape == ())


def jumps_of_one_state(problem: Problem, n: int) -> None:
    """Refuse functions of a jump that cannot be traced on one state of ``n`` numbers, or return the wrong shape.

    Raises:
      ValueError: names the jump.
    """
    lengths, letters = _lengths(problem, n), problem.arguments("x", "u", "d", "t")
    for number, jump in enumerate(problem.jumps):
        for name, wanted in (("rate", ()), ("landing", (n,)), ("cost", ()), ("reward", ())):
            if callable(function := getattr(jump, name)):
                said = f"Problem.jumps[{number}].{name}: {name}"
                function_of(function, said, wanted, **{letter: lengths[letter] for letter in letters})


# --- on one state ---


def call(problem: Problem, name: str) -> str:
    """A function with the arguments that the problem passes, as in ``drift(x, u)``."""
    said = USERS_NAMES.get(name) or problem.labels.word(name)
    if not callable(getattr(problem, name)):
        return said
    return f"{said}({', '.join(_names(problem, name))})"


def _names(problem: Problem, name: str) -> tuple[str, ...]:
    """The arguments that the problem passes to one of its functions, as letters."""
    if name in OF_ACTION:
        return problem.arguments("x", "u", "d", "t")
    return problem.state_arguments("x", "t")


def _expect(problem: Problem, name: str, n: int, wanted: str, fits: Callable[[tuple], bool], why: str) -> None:
    """Refuse an ingredient of the wrong kind or shape."""
    ingredient = getattr(problem, name)
    if ingredient is None:
        return
    verdict = _shape_or_fault(problem, name, n)
    if isinstance(verdict, str):  # the most common mistakes get advice
        hint = ""
        if verdict.startswith(("a list", "a tuple")) and wanted != "()":
            hint = ": use jnp.stack([...])"
        if name == "target" and "bool" in verdict:
            hint = ": a distance ≤ 0 inside, as jnp.linalg.norm(x) - 0.1"
        raise ValueError(
            f"{call(problem, name)} returned {verdict}, expected floating-point numbers of shape {wanted}{hint}"
        )
    if not fits(verdict):
        raise ValueError(f"{call(problem, name)} returned shape {verdict}, expected {wanted}: {why}")


def _shape_or_fault(problem: Problem, name: str, n: int) -> tuple[int, ...] | str:
    """The shape of an ingredient, or of its result if it is a function; a description if it is not numeric."""
    ingredient = getattr(problem, name)
    return _probe(problem, name, n) if callable(ingredient) else _verdict(ingredient)


def _verdict(result: Any) -> tuple[int, ...] | str:
    """The shape of floating-point numbers; a description of anything else."""
    if result is None or isinstance(result, str):
        return repr(result)
    if isinstance(result, (list, tuple, dict)):
        return f"a {type(result).__name__} of {len(result)}"
    try:
        dtype, shape = jnp.result_type(result), jnp.shape(result)
    except TypeError:
        return f"an object of type {type(result).__name__}"
    if jnp.issubdtype(dtype, jnp.floating):
        return shape
    plain = isinstance(result, int) or getattr(result, "weak_type", False)  # `cost=lambda x, u: 1` is a number
    if jnp.issubdtype(dtype, jnp.integer) and plain:
        return shape
    return f"{dtype} numbers"


def _probe(problem: Problem, name: str, n: int) -> tuple[int, ...] | str:
    """The shape of a function's result on one state, found by tracing it, or a description if it is not numeric."""
    names, lengths = _names(problem, name), _lengths(problem, n)
    _check_arity(problem, name)
    return _probed(getattr(problem, name), {letter: lengths[letter] for letter in names}, call(problem, name))


def _probed(function: Callable, fed: Mapping[str, tuple[int, ...]], said_call: str) -> tuple[int, ...] | str:
    """``_probe`` for given shapes of the arguments and a given name for messages."""
    # a user's function may raise anything: JAX's errors get advice, errors about shapes are quoted
    try:
        verdict, outside, *_ = _trace_once(function, tuple(fed), tuple(fed.values()))
    except Exception as error:
        if said := refusal(error, said_call, fed):
            raise ValueError(said) from error
        # the user's own exceptions keep their type, so that they can be caught
        error.add_note(f"raised by {said_call}, traced on one state, with {_in_words(fed)}")
        raise
    if outside is not None:  # JAX never raises here, see ``indices``
        raise ValueError(f"{said_call} reads {outside}.\nJAX would silently use the nearest entry, or none.")
    return verdict


def refusal(error: Exception, said_call: str, fed: Mapping[str, tuple[int, ...]]) -> str | None:
    """The message for a function, ``drift(x, u)``, that failed on one state; None for a user's own exception."""
    if said := cure(error):
        return f"{said_call} {said}.\nIt is traced once on one state, with {_in_words(fed)}"
    if isinstance(error, (TypeError, ValueError, IndexError)):
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        hint = next((f"\n{advice}" for words, advice in _SLIPS if words in said), "")
        return f"{said_call} failed on one state, with {_in_words(fed)}:\n{said[:400]}{hint}"
    return None


def _in_words(fed: Mapping[str, tuple[int, ...]]) -> str:
    """Shapes of arguments, as in "x of shape (2,), u of shape (1,)"."""
    return ", ".join(f"{letter} of shape {shape}" for letter, shape in fed.items())


def function_of(function: Callable, name: str, wanted: tuple[int, ...], **fed: tuple[int, ...]) -> None:
    """Refuse a function outside a problem that cannot be traced, or returns the wrong shape.

    Args:
      function: the function passed to a plot or a search.
      name: its name in messages.
      wanted: the shape of its result.
      **fed: the shapes of its arguments, by name.

    Raises:
      ValueError: the message shows the wrong result, or the reason why the function cannot be traced.
    """
    said_call = f"{name}({', '.join(fed)})"
    with own_settings(x64=True):
        verdict = _probed(as_partial(function, name) or function, fed, said_call)
    if verdict != wanted:
        returned = verdict if isinstance(verdict, str) else f"shape {verdict}"
        raise ValueError(f"{said_call} returned {returned}, expected {wanted or 'one number'} for one state")


def _lengths(problem: Problem, n: int) -> dict[str, tuple[int, ...]]:
    """The shapes of the arguments of one state."""
    return {"x": (n,), "u": (_dim(problem.controls),), "d": (_dim(problem.disturbances),), "t": ()}


def problem_calls_back(problem: Problem, n: int) -> bool:
    """True if a function of a problem calls Python while it runs."""
    lengths = _lengths(problem, n)
    with own_settings(x64=True):
        for name in (*OF_ACTION, "target", *STATE_COSTS, *RATES):
            function, names = getattr(problem, name), _names(problem, name)
            if callable(function) and _trace_once(function, names, tuple(lengths[letter] for letter in names))[2]:
                return True
    return False


def operations_of(problem: Problem, n: int) -> Operations:
    """The operations of one evaluation of all functions of a problem with ``n`` states, as written out for XLA."""
    lengths, total = _lengths(problem, n), Operations()
    with own_settings(x64=True):
        for name in (*OF_ACTION, "target", *STATE_COSTS, *RATES):
            function, names = getattr(problem, name), _names(problem, name)
            if callable(function):
                total += _trace_once(function, names, tuple(lengths[letter] for letter in names))[3]
    return total


@remembered
def _trace_once(
    function: Callable, names: tuple[str, ...], lengths: tuple[tuple[int, ...], ...]
) -> tuple[tuple[int, ...] | str, str | None, bool, Operations]:
    """Shape or fault of a function's result, an index outside its array, True if it calls Python, its operations."""
    verdicts = []  # recorded while tracing, because ``make_jaxpr`` would raise its own error on a result that is text

    def probe(*arguments: jax.Array) -> Any:
        result = function(*arguments)
        verdicts.append(_verdict(result))
        return () if isinstance(verdicts[0], str) else result

    closed = jax.make_jaxpr(probe)(*(jax.ShapeDtypeStruct(shape, np.float64) for shape in lengths))
    return verdicts[0], indices.first_outside(closed, names), jaxprs.calls_back(closed.jaxpr), operations(closed)


def _dim(admissible: sets.AdmissibleSet | None) -> int:
    """The number of inputs; zero without a set."""
    return 0 if admissible is None else admissible.dim


def _check_arity(problem: Problem, name: str) -> None:
    """Refuse a function with other arguments than the problem passes, more clearly than a trace would."""
    try:
        signature = inspect.signature(getattr(problem, name))
    except (TypeError, ValueError):  # a builtin has no signature
        return
    try:
        signature.bind(*_names(problem, name))
    except TypeError as error:
        time = "t first because time_dependent=True" if problem.time_dependent else "t only with time_dependent=True"
        players = "d because disturbances are given" if problem.is_game else "d only with disturbances"
        why = f"x and u always; {players}; {time}" if name in OF_ACTION else f"x always; {time}"
        raise ValueError(
            f"{problem.labels.word(name)} does not take the arguments that the problem passes, {call(problem, name)}: "
            f"{error}.\nWhy: {why}"
        ) from error


def over_devices(
    mesh: Mesh | None, caller: str, problem: Problem, grid: Grid, *choices: Any, traced: bool
) -> Mesh | None:
    """The mesh over which to divide the nodes, after checks; None for one device.

    Args:
      mesh: the user's argument.
      caller: the public function, for messages.
      problem, grid: the problem and its grid.
      *choices: scheme and methods, each of which must be able to run in parts.
      traced: True if the call is inside a JAX transformation.

    Raises:
      TypeError, ValueError: an argument that works on one device only.
    """
    if mesh is None:
        return None
    if traced:
        raise ValueError(f"{caller}: mesh divides the nodes at host level only; leave it out inside jit, vmap and grad")
    mesh = as_mesh(mesh, caller)
    check_division(problem, grid, mesh.devices.shape, caller, *choices)
    if problem_calls_back(problem, grid.ndim):
        raise ValueError(
            f"{caller}: a function of the problem calls Python on the host; leave out mesh, or write it in JAX"
        )
    if grid.modes:  # every device has all modes of its nodes
        mesh = Mesh(mesh.devices[None], ("modes of the problem", *mesh.axis_names))
    return mesh if mesh.size > 1 else None


def check_division(problem: Problem, grid: Grid, counts: tuple[int, ...], caller: str, *choices: Any) -> None:
    """Check that the nodes can be divided into these numbers of parts along the axes, without tracing the problem.

    Raises:
      ValueError: they cannot, or the problem or one of the choices works on one device only.
    """
    counts = (1, *counts) if grid.modes else counts
    if problem.landings is not None or problem.jumps:
        raise ValueError(
            f"{caller}: got a mesh and a problem with jumps: a jump may land on a node of any device. Leave out mesh"
        )
    for axis, _ in (*problem.push_steps, *(push.step for push in problem.pushes)):
        if axis < len(counts) and counts[axis] > 1:
            raise ValueError(
                f"{caller}: mesh divides axis {axis - bool(grid.modes)}, along which the problem has pushes: a node "
                "may be\npushed through the nodes of several devices. Divide other axes, or leave out mesh"
            )
    refuse_prescribed(grid, caller, "whose numbers are not divided over a mesh")
    check_parts(counts, grid.shape, caller, *choices)
