"""What a problem must satisfy on a grid before a solve starts; host level, never under a tracer.

``shapes`` traces every function on one state and allocates nothing. ``values`` evaluates them at all nodes, for
representative actions, and reduces on the fly to counts and first nodes. Both name what they refuse, and the way out.
"""

import functools
import inspect
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax import chain, correlation, fields, sets
from hjbjax.grid import Grid
from hjbjax.problem import Problem

_OF_ACTION = ("drift", "cost", "noise")
_STATE_COSTS = ("exit_cost", "terminal_cost", "stopping_cost", "running_max")
_ACTIONS = 33  # at most so many actions of one player are tried, 9 where both play; ends and middle are among them

_TRACED = (  # most special first
    (
        (jax.errors.TracerBoolConversionError, jax.errors.NonConcreteBooleanIndexError),
        "decides by Python `if`, `and`, `min`, `max` or a mask on a traced value: use jnp.where (jnp.minimum, ...)",
    ),
    (jax.errors.TracerArrayConversionError, "hands a traced value to NumPy: use jnp in place of np"),
    (jax.errors.TracerIntegerConversionError, "indexes by a traced value: use jnp.asarray(table)[i]"),
    (
        jax.errors.ConcretizationTypeError,
        "needs a traced value as a number: use jnp in place of np, math, float() and int(), and jnp.where for `if`",
    ),
)


def shapes(problem: Problem, grid: Grid, scheme: Any) -> None:
    """Refuse functions that cannot be traced on one state or return something else than they should.

    Args:
      problem: the problem.
      grid: the grid; only its number of axes and their points matter.
      scheme: the scheme; one with a number ``points`` needs as many points an axis.

    Raises:
      ValueError: a result of the wrong shape or kind, a wrong number of arguments, code that JAX cannot trace.
    """
    needed = getattr(scheme, "points", 2)
    for axis, count in enumerate(grid.shape):
        if count < needed:
            raise ValueError(f"axis {axis} has {count} points; {type(scheme).__name__} needs at least {needed}")
    n = grid.ndim
    if any(grid.stretch or ()) and np.ndim(problem.noise) == 2:
        raise ValueError("correlated noise wants equal spacings: leave out Grid.stretch, or give noise by axis, (n,)")
    with jax.enable_x64(True):
        _expect(problem, "drift", n, f"({n},)", lambda shape: shape == (n,))
        _expect(
            problem, "noise", n, f"(), ({n},) or ({n}, k)", lambda shape: shape[:1] in ((), (n,)) and len(shape) <= 2
        )
        for name in ("cost", "target", *_STATE_COSTS):
            _expect(problem, name, n, "()", lambda shape: shape == ())


def values(problem: Problem, grid: Grid, scheme: Any, dtype: Any) -> None:
    """Refuse what the functions return at the nodes: NaN, an empty target, noise that the chain cannot represent.

    Args:
      problem: the problem; one that passed ``shapes``.
      grid: the grid.
      scheme: the scheme; the diagonal jumps of correlated noise are the same for all.
      dtype: the floating-point type in which the functions are evaluated.

    Raises:
      ValueError: with the number of nodes, the first of them and its state, and what to do.
    """
    actions = _actions(problem)
    with jax.enable_x64(True):
        found = jax.device_get(_survey(problem, grid, actions, dtype=np.dtype(dtype)))
    for name in (*_OF_ACTION, "target", *_STATE_COSTS):
        if name in found and found[name].count:
            _not_finite(problem, grid, name, found[name], actions)
    if "negative" in found and found["negative"].count:
        where = _where(problem, grid, found["negative"], actions)
        raise ValueError(
            f"{_call(problem, 'noise')} is negative at {where}.\nWanted numbers ≥ 0: it is σ in dx = f dt + σ dw; "
            "only an (n, k) matrix may hold negative entries"
        )
    if "correlation" in found and found["correlation"].count:
        _not_representable(problem, grid, found["correlation"], actions)
    if problem.target is not None:
        _target(problem, grid, found["inside"], found["nearest"])


def ill_posed(problem: Problem, has_rest: bool) -> None:
    """Refuse an endless sum of costs: no discount, and nothing that ends the path or lets it rest at no cost.

    Args:
      problem: the problem.
      has_rest: whether there is a node where the system can rest at no cost.

    Raises:
      ValueError: there is no finite solution; with what would give one.
    """
    ends = (problem.target, problem.stopping_cost, problem.running_max)
    if problem.discount > 0 or has_rest or any(end is not None for end in ends):
        return
    raise ValueError(
        "Problem: there is no finite solution: discount = 0, and the cost is paid for ever, since there is no target,\n"
        "no stopping_cost, no running_max and no node where the system can rest at no cost.\n"
        "Give discount > 0, or a target, or put a rest point (drift 0 and cost 0 for some control) on a node,\n"
        "or march over a finite horizon"
    )


# --- on one state ---


def _call(problem: Problem, name: str) -> str:
    """How the problem calls one of its functions, as in ``drift(x, u)``."""
    if not callable(getattr(problem, name)):
        return name
    return f"{name}({', '.join(_names(problem, name))})"


def _names(problem: Problem, name: str) -> tuple[str, ...]:
    if name in _OF_ACTION:
        return problem.arguments("x", "u", "d", "t")
    return problem.state_arguments("x", "t")


def _expect(problem: Problem, name: str, n: int, wanted: str, fits: Callable[[tuple], bool]) -> None:
    """Refuse an ingredient of the wrong kind or shape."""
    ingredient = getattr(problem, name)
    if ingredient is None:
        return
    verdict = _probe(problem, name, n) if callable(ingredient) else _verdict(ingredient)
    if isinstance(verdict, str):
        hint = ""
        if verdict.startswith(("a list", "a tuple")) and wanted != "()":
            hint = ": use jnp.stack([...])"
        if name == "target" and "bool" in verdict:
            hint = ": a distance ≤ 0 inside, as jnp.linalg.norm(x) - 0.1"
        raise ValueError(
            f"{_call(problem, name)} returned {verdict}, expected floating-point numbers of shape {wanted}{hint}"
        )
    if not fits(verdict):
        axes = "a scalar" if wanted == "()" else f"n = {n} is the number of axes of the grid"
        raise ValueError(f"{_call(problem, name)} returned shape {verdict}, expected {wanted}: {axes}")


def _verdict(result: Any) -> tuple[int, ...] | str:
    """The shape of floating-point numbers; of anything else a description."""
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
    """What a function returns on one state, found by tracing it."""
    function, names, call = getattr(problem, name), _names(problem, name), _call(problem, name)
    lengths = {"x": (n,), "u": (_dim(problem.controls),), "d": (_dim(problem.disturbances),), "t": ()}
    arguments = [jax.ShapeDtypeStruct(lengths[letter], np.float64) for letter in names]
    verdicts = []

    def probe(*arguments):
        verdicts.append(_verdict(function(*arguments)))

    _check_arity(problem, name)
    try:
        jax.eval_shape(probe, *arguments)
    except Exception as error:
        fed = ", ".join(f"{letter} of shape {lengths[letter]}" for letter in names)
        for kind, advice in _TRACED:
            if isinstance(error, kind):
                raise ValueError(f"{call} {advice}.\nIt is traced once on one state, with {fed}") from error
        if isinstance(error, (TypeError, ValueError, IndexError)):
            said = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise ValueError(f"{call} failed on one state, with {fed}:\n{said[:400]}") from error
        error.add_note(f"raised by {call}, traced on one state, with {fed}")
        raise
    return verdicts[0]


def _dim(choices: sets.AdmissibleSet | None) -> int:
    return 0 if choices is None else choices.dim


def _check_arity(problem: Problem, name: str) -> None:
    try:
        signature = inspect.signature(getattr(problem, name))
    except (TypeError, ValueError):  # a builtin says nothing about its arguments
        return
    try:
        signature.bind(*_names(problem, name))
    except TypeError as error:
        time = "t first because time_dependent=True" if problem.time_dependent else "t only with time_dependent=True"
        players = "d because disturbances are given" if problem.is_game else "d only with disturbances"
        why = f"x and u always; {players}; {time}" if name in _OF_ACTION else f"x always; {time}"
        raise ValueError(
            f"{name} does not take the arguments that the problem passes, {_call(problem, name)}: {error}.\nWhy: {why}"
        ) from error


# --- at all nodes ---


class _Finding(NamedTuple):
    """How many nodes, the first of them (flat), and for which action."""

    count: Any
    first: Any
    action: Any


def _actions(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Representative pairs of control and disturbance, shapes (K, m) and (K, l)."""
    most = 9 if problem.is_game else _ACTIONS
    mine, theirs = (_thinned(choices, most) for choices in (problem.controls, problem.disturbances))
    pairs = list(itertools.product(mine, theirs))
    return np.array([u for u, _ in pairs]), np.array([d for _, d in pairs])


def _thinned(choices: sets.AdmissibleSet | None, most: int) -> np.ndarray:
    if choices is None:
        return np.zeros((1, 0))
    points = np.asarray(sets.samples(choices, 9))
    return points[np.unique(np.linspace(0, len(points) - 1, min(most, len(points))).round().astype(int))]


@functools.partial(jax.jit, static_argnames=("dtype",))
def _survey(problem: Problem, grid: Grid, actions: tuple[Any, Any], dtype: Any) -> dict[str, Any]:
    """Counts and first nodes of everything that ``values`` refuses."""
    x = grid.components(dtype)
    found: dict[str, Any] = {}
    inside: Any = True
    if problem.target is not None:
        distance = jnp.broadcast_to(_of_state(problem, problem.target, x, dtype), grid.shape)
        inside = distance <= 0
        found["target"] = _count(~jnp.isfinite(distance), grid)
        found["inside"] = jnp.sum(inside)
        found["nearest"] = (jnp.min(distance), jnp.argmin(distance))
    for name in _STATE_COSTS:
        ingredient = getattr(problem, name)
        if ingredient is not None:
            relevant = inside if name == "exit_cost" else True
            found[name] = _count(relevant & ~jnp.isfinite(_of_state(problem, ingredient, x, dtype)), grid)

    def body(carry, index_and_action):
        index, u, d = index_and_action
        here, u, d = jax.lax.optimization_barrier((x, u, d))  # or XLA keeps an array of all nodes per invariant
        new = _of_action(problem, grid, here, list(u), list(d), dtype)
        new = {name: _count(bad, grid, index) for name, bad in new.items()}
        kept = {
            name: jax.tree.map(functools.partial(jnp.where, carry[name].count > 0), carry[name], new[name])
            for name in new
        }
        return kept, None

    us, ds = (jnp.asarray(action, dtype) for action in actions)
    nothing = _Finding(*(jnp.zeros((), jnp.int64),) * 3)
    names = jax.eval_shape(lambda: _of_action(problem, grid, x, list(us[0]), list(ds[0]), dtype))
    carry, _ = jax.lax.scan(body, dict.fromkeys(names, nothing), (jnp.arange(len(us)), us, ds))
    return found | carry


def _of_state(problem: Problem, ingredient: Any, x: list, dtype: Any) -> Any:
    """A function of the state alone, or a number, on per-node scalars."""
    return jnp.asarray(fields.scalar(ingredient, *problem.state_arguments(x, 0.0), dtype=dtype))


def _of_action(problem: Problem, grid: Grid, x: list, u: list, d: list | None, dtype: Any) -> dict[str, Any]:
    """Where drift, cost and noise are what they must not be, for one action."""

    def faulty(entries):
        return functools.reduce(jnp.logical_or, (~jnp.isfinite(jnp.asarray(entry, dtype)) for entry in entries))

    bad = {"drift": faulty(chain.drift(problem, x, u, d, 0.0, dtype))}
    if problem.cost is not None:
        bad["cost"] = faulty([chain.running_cost(problem, x, u, d, 0.0, dtype)])
    a = chain.diffusion(problem, x, u, d, 0.0, dtype)
    if a:
        bad["noise"] = faulty(a.values())
    if callable(problem.noise):
        sigma = fields.components(problem.noise, *problem.arguments(x, u, d, 0.0), dtype=dtype)
        if sigma.ndim < 2:
            bad["negative"] = functools.reduce(jnp.logical_or, (jnp.asarray(entry) < 0 for entry in sigma.flat))
    if any(i != j for i, j in a):
        slack = 16 * grid.ndim * jnp.finfo(dtype).eps  # rounding of σσᵀ and of the spacings
        lacking = (
            chain.along_axis(a, grid, axis) < -slack * jnp.asarray(a[axis, axis], dtype) for axis in range(grid.ndim)
        )
        bad["correlation"] = functools.reduce(jnp.logical_or, lacking)
    return bad


def _count(bad: Any, grid: Grid, action: Any = 0) -> _Finding:
    bad = jnp.broadcast_to(bad, grid.shape)
    # counting and argmax are slow on a CPU: they run where there is something to find
    count, first = jax.lax.cond(
        jnp.any(bad),
        lambda: (jnp.sum(bad, dtype=jnp.int64), jnp.argmax(bad).astype(jnp.int64)),
        lambda: (jnp.zeros((), jnp.int64),) * 2,
    )
    return _Finding(count, first, jnp.asarray(action, jnp.int64))


# --- what is said ---


def _numbers(entries: Any) -> str:
    return "[" + ", ".join(f"{entry:.6g}" for entry in np.asarray(entries, dtype=float)) + "]"


def _place(grid: Grid, flat: Any) -> tuple[tuple[int, ...], np.ndarray]:
    index = tuple(int(i) for i in np.unravel_index(int(flat), grid.shape))
    return index, grid.state(index)


def _where(problem: Problem, grid: Grid, finding: _Finding, actions: tuple | None) -> str:
    """ "3 of 100 nodes, first at node (0, 1), x = [...], with u = [...]"."""
    index, x = _place(grid, finding.first)
    text = f"{int(finding.count)} of {grid.size} nodes, first at node {index}, x = {_numbers(x)}"
    if actions is not None:
        given = zip("ud", actions, strict=True)
        played = [f"{letter} = {_numbers(rows[finding.action])}" for letter, rows in given if rows.shape[1]]
        text += ", with " + " and ".join(played) if played else ""
    return text


def _not_finite(problem: Problem, grid: Grid, name: str, finding: _Finding, actions: tuple) -> NoReturn:
    ingredient = getattr(problem, name)
    if not callable(ingredient):
        raise ValueError(f"Problem.{name}: got {np.asarray(ingredient)}, wanted finite numbers")
    where = _where(problem, grid, finding, actions if name in _OF_ACTION else None)
    raise ValueError(
        f"{_call(problem, name)} is NaN or infinite at {where}.\n"
        "Keep the singularity out of the box (lo, hi) or between nodes (shape), or define the function there:\n"
        "jnp.where(bad, finite, f(jnp.where(bad, safe_x, x)))"
    )


def _target(problem: Problem, grid: Grid, inside: Any, nearest: tuple[Any, Any]) -> None:
    if 0 < inside < grid.size:
        return
    if inside:
        raise ValueError(
            f"target: all {grid.size} nodes lie in the target ({_call(problem, 'target')} ≤ 0 inside), so nothing is "
            "left to solve: enlarge the box or make the target smaller; check its sign"
        )
    index, x = _place(grid, nearest[1])
    raise ValueError(
        f"target: no node lies in the target: {_call(problem, 'target')} ≤ 0 inside, but its least value is "
        f"{float(nearest[0]):.6g}, at node {index}, x = {_numbers(x)}: refine the grid or enlarge the target"
    )


def _not_representable(problem: Problem, grid: Grid, finding: _Finding, actions: tuple) -> NoReturn:
    """Refuse correlated noise, with spacings for which its diagonal jumps leave no negative probability."""
    _, x = _place(grid, finding.first)
    u, d = (rows[finding.action] for rows in actions)
    sigma = np.asarray(problem.diffusion(x, u, d, 0.0), dtype=float)
    a = sigma @ sigma.T
    h = np.array([grid.spacing(axis) for axis in range(grid.ndim)], dtype=float)
    head = (
        f"noise: correlated noise that the chain cannot represent with non-negative probabilities at "
        f"{_where(problem, grid, finding, actions)}.\n"
        f"Every axis i needs a_ii/h_i ≥ Σ_j |a_ij|/h_j (a = σσᵀ); here diag a = {_numbers(np.diag(a))}, "
        f"h = {_numbers(h)}.\n"
    )
    wanted = correlation.spacings(a, h)
    if wanted is None:
        raise ValueError(
            head + "No spacing of these axes will do: turn the state's axes so that a becomes (nearly) diagonal, "
            "or weaken the correlation"
        )
    shape = correlation.shape(a, grid, wanted)
    everywhere = "there" if callable(problem.noise) else "everywhere"
    if shape is not None:
        raise ValueError(head + f"Use Grid(..., shape={shape}): representable {everywhere}")
    raise ValueError(
        head + f"Choose lo, hi and shape so that the spacings are as {_numbers(wanted / wanted[0])} to one another: "
        f"representable {everywhere}; with this box no shape near {grid.shape} has that ratio"
    )
