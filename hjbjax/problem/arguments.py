"""Checks of arguments shared by the package: numbers, counts, choices, and the arguments of a Grid.

Each check takes the name of the argument as the user knows it, as in ``"solve: tol"``. Its message has that name, the
value and the wanted value. Tracers pass, because inside a JAX transformation values are unknown.
"""

import contextlib
import difflib
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hjbjax.problem.ends import KINDS, PRESCRIBED
from hjbjax.problem.layouts import FEWEST
from hjbjax.problem.pytree import is_traced, numbers
from hjbjax.problem.stretching import Sinh, Stretching
from hjbjax.problem.types import Array, DType, Key
from hjbjax.problem.words import shown

P = ParamSpec("P")
T = TypeVar("T")

COINCIDING = 16  # units in the last place of a coordinate; every spacing must be larger
INDEXABLE = 2**31  # nodes that 32-bit indices can number
NO_GRID = "hjb.pontryagin(problem, x0) finds the optimal path from one state without a grid"
EDGES = ("projected", "constrained", "open", "linear")  # ends without numbers: static, hashable, saved as names
Ends = tuple[str, str] | None  # the kinds of the lower and the upper end of an axis; None for a periodic axis


def with_calls_by_name(
    function: Callable[P, T], call: Callable[[Callable[..., T], dict[str, Any]], Any]
) -> Callable[P, T]:
    """The function whose calls become ``call(function, given)``, with all arguments of the call by name in ``given``.

    Arguments that do not fit go to ``function``, which raises Python's TypeError.
    """
    signature = inspect.signature(function)
    rest = [each.name for each in signature.parameters.values() if each.kind is each.VAR_KEYWORD]

    @functools.wraps(function)
    def called(*arguments: P.args, **options: P.kwargs) -> Any:
        try:
            given = dict(signature.bind(*arguments, **options).arguments)
        except TypeError:
            return function(*arguments, **options)
        for name in rest:  # ``**options``
            given |= given.pop(name, {})
        return call(function, given)

    return called


def positive(value: T, name: str, unit: str = "", *, most: float = math.inf, endless: bool = False) -> T:
    """The value, after checking that it is one finite number above zero.

    Args:
      value: the user's value.
      name: the argument.
      unit: the unit of the number, as in "in units of time".
      most: the largest admissible number.
      endless: True if infinity is admissible.

    Raises:
      ValueError: zero, negative, NaN, infinite, a boolean, an array, or not a number.
    """
    if is_traced(value) or (endless and is_number(value) and value == math.inf):
        return value
    # in NumPy: inside ``jit`` a comparison with a JAX number is traced and has no truth value
    number: Any = np.asarray(value) if isinstance(value, jax.Array) else value
    if not (is_number(value) and math.isfinite(number) and 0 < number <= most):
        wanted = "a finite number > 0" if most == math.inf else f"a number > 0 and at most {most:g}"
        raise ValueError(f"{name} = {shown(value)}; wanted {wanted}{unit and ', ' + unit}")
    return value


def count(value: object, name: str, least: int = 1) -> int:
    """The value, after checking that it is an integer of at least ``least``.

    Raises:
      ValueError: too small, a float, a boolean, or not a number.
    """
    # Python counts True as an integer, and 3.0 is more likely a mistake than a count
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        wanted = "a positive integer" if least == 1 else f"an integer of at least {least}"
        raise ValueError(f"{name} = {shown(value)}; wanted {wanted}")
    return int(value)


def random_key(given: Any, name: str, *, batch: bool = False) -> Key:
    """The random key, the key of a seed, or an array of keys if ``batch``.

    Raises:
      ValueError: neither a key nor a seed, a seed beyond 64 bits, or more keys than are admissible.
    """
    key = given
    if isinstance(given, (int, np.integer)) and not isinstance(given, bool):
        try:
            key = jax.random.key(int(given))
        except OverflowError:
            raise ValueError(f"{name} is {given}, wanted a seed that fits 64 bits, or a JAX random key") from None
    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key)
    keys = typed or (dtype == np.uint32 and np.ndim(key) > 0)
    if not keys or len(keys_shape(key)) > batch:
        got = shown(given) if dtype is None else f"an array of shape {np.shape(key)} and type {dtype}"
        wanted = "a JAX random key, a row of them" if batch else "one random key"
        raise ValueError(f"{name} is {got}, wanted {wanted}: key=jax.random.key(0), or another seed")
    return key


def as_dtype(dtype: DType | None) -> np.dtype:
    """The floating-point type that the user chose; float64 by default."""
    # np.dtype accepts many spellings, and raises TypeError for others
    for kind in (np.dtype(np.float64), np.dtype(np.float32)):
        with contextlib.suppress(TypeError):
            if kind == (np.float64 if dtype is None else np.dtype(dtype)):
                return kind
    raise ValueError(f"dtype: got {dtype!r}, wanted 'float64' or 'float32'")


def traced_dtype(dtype: DType | None, name: str) -> np.dtype:
    """The floating-point type inside a JAX transformation; JAX's default float by default."""
    if dtype is None:
        return np.dtype(jnp.result_type(float))
    kind = as_dtype(dtype)
    if kind == np.float64 and kind != np.dtype(jnp.result_type(float)):  # JAX would continue in float32 with a warning
        raise ValueError(
            f"{name}: got dtype={dtype!r} inside jit, vmap or grad, where JAX is set to 32 bits and a type cannot be "
            "changed; put `with jax.enable_x64(True):` around the call of the transformed function"
        )
    return kind


def keys_shape(keys: Any) -> tuple[int, ...]:
    """The shape of an array of random keys; () for one key."""
    # there are two kinds of keys: typed ones, and rows of uint32 from jax.random.PRNGKey
    return np.shape(keys) if jax.dtypes.issubdtype(keys.dtype, jax.dtypes.prng_key) else np.shape(keys)[:-1]


def is_number(value: object) -> bool:
    """True if ``value`` is one real number; booleans and text do not count."""
    if isinstance(value, (bool, str, bytes)) or value is None:
        return False
    if isinstance(value, int):  # NumPy stores an integer like 10^20 as an object
        return value.bit_length() < 1024  # below 2^1023, where float() cannot overflow
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # a ragged list, or an object that cannot become an array
        return False
    return array.ndim == 0 and array.dtype.kind in "fiu"


def axis_names(given: object, count: int) -> tuple[str, ...]:
    """One name per axis; x1, x2, ... by default.

    Raises:
      TypeError: not a sequence of names.
    """
    if not isinstance(given, Iterable):
        raise TypeError(f"Grid.names: got {shown(given)}, wanted one name per axis, as in ('angle', 'rate')")
    return tuple(str(name) for name in given) or tuple(f"x{axis + 1}" for axis in range(count))


def _is_left_out(entries: object) -> bool:
    """True for the defaults of entries per axis: () and None. An array is compared with neither."""
    return entries is None or (isinstance(entries, tuple) and not entries)


def stretchings(stretch: Any, n: int) -> tuple[Stretching | None, ...]:
    """The stretching of each of the n axes; None and () mean that no axis is stretched."""
    if _is_left_out(stretch):
        return (None,) * n
    if isinstance(stretch, str) or not isinstance(stretch, Iterable):
        raise TypeError(f"Grid.stretch: got {stretch!r}, wanted one entry per axis, as in (hjb.Sinh(3.0), None)")
    return tuple(stretch)


def check_stretch(stretch: tuple, periodic: tuple[bool, ...]) -> None:
    """Refuse stretchings of another type, and stretchings of periodic axes."""
    for axis, (stretching, cyclic) in enumerate(zip(stretch, periodic, strict=True)):
        if stretching is not None and not isinstance(stretching, Sinh):
            raise TypeError(f"Grid.stretch: entry {axis} is {stretching!r}; wanted Sinh(strength, center) or None")
        if stretching is not None and cyclic:
            raise ValueError(f"Grid.stretch: axis {axis} is periodic; only an axis with ends can be stretched")


def pairs_of_ends(edges: object, periodic: tuple[bool, ...], shape: tuple[int, ...]) -> tuple[Any, ...]:
    """Both ends of every axis, checked: names and prescribed ends; None for a periodic axis."""
    if edges is None or isinstance(edges, (str, *PRESCRIBED)):
        _kind(edges, "every end")
        edges = [None if cyclic else edges for cyclic in periodic]
    if not isinstance(edges, Sequence) or len(edges) != len(periodic):
        pair = '(("open", "constrained"),)' if len(periodic) == 1 else '("open", ("projected", "constrained"))'
        raise ValueError(
            f"Grid.edges: got {edges!r} for {len(periodic)} axes; wanted a name for all, or one entry per axis: a name "
            f"or a pair (lower end, upper end), as in {pair}"
        )
    return tuple(_ends(entry, axis, periodic[axis], shape[axis]) for axis, entry in enumerate(edges))


def kinds_of_ends(pairs: tuple[Any, ...]) -> tuple[Ends, ...]:
    """The kinds of both ends of every axis by their names."""
    return tuple(pair and (_kind(pair[0], ""), _kind(pair[1], "")) for pair in pairs)


def _ends(entry: object, axis: int, cyclic: bool, count: int) -> tuple[Any, Any] | None:
    """The two ends of one axis."""
    if cyclic and entry is not None:
        raise ValueError(f"Grid.edges: axis {axis} is periodic and has no ends; got {entry!r} there, wanted None")
    if cyclic:
        return None
    # a name means both ends; a string is a Sequence, so it would be read as a list of letters
    pair = (entry, entry) if entry is None or isinstance(entry, (str, *PRESCRIBED)) else entry
    if not isinstance(pair, Sequence) or len(pair) != 2:
        raise ValueError(f"Grid.edges: axis {axis} has {entry!r}; wanted a name or a pair (lower end, upper end)")
    kinds = [_kind(end, f"axis {axis}") for end in pair]
    if "open" in kinds and count < 3:  # a parabola extends V beyond the end
        raise ValueError(
            f"Grid.edges: axis {axis} has {count} points; an open end extends V from the last three. Use more points, "
            "or edges='linear', which needs only two"
        )
    return pair[0], pair[1]


def _kind(name: object, where: str) -> str:
    """The kind of one end, given by name or as a prescribed end; "projected" by default."""
    if name is None:
        return "projected"
    if isinstance(name, PRESCRIBED):
        return name.kind
    if not isinstance(name, str) or name not in (*EDGES, *KINDS):
        near = difflib.get_close_matches(str(name), EDGES, 1, 0.4)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(
            f"Grid.edges: got {name!r} for {where}; wanted one of {', '.join(map(repr, EDGES))}, or a prescribed end: "
            f"hjb.Dirichlet(value), hjb.Neumann(slope) or hjb.Robin(rate){hint}"
        )
    return name


def corner(value: object, name: str) -> Array:
    """One corner of the box: one number per axis."""
    corner = numbers(value, f"Grid.{name}")
    if np.ndim(corner) != 1 or np.size(corner) == 0:
        raise ValueError(f"Grid.{name}: got {shown(value)}, wanted a list of numbers, one per axis")
    return corner


def counts(shape: object) -> tuple[int, ...]:
    """The number of points of every axis, at least two."""
    if isinstance(shape, str) or not isinstance(shape, (Sequence, np.ndarray)):
        raise TypeError(f"Grid.shape: got {shape!r}, wanted a tuple of integers, one per axis")
    for axis, count in enumerate(shape):
        # Python counts True as 1; a boolean here was probably meant for ``periodic``
        if isinstance(count, (bool, np.bool_)) or not isinstance(count, (int, np.integer)):
            raise TypeError(f"Grid.shape: axis {axis} has {count!r} points; wanted an integer")
        if count < 2:
            raise ValueError(f"Grid.shape: axis {axis} has {count} points; wanted at least 2")
    return tuple(int(count) for count in shape)


def periodic_flags(periodic: object, n: int) -> tuple[bool, ...]:
    """One flag for each of the n axes, True if it is periodic; None and () mean that no axis is."""
    if _is_left_out(periodic):
        return (False,) * n
    wanted = f"wanted one bool per axis (not axis numbers), as in {(True,) + (False,) * (n - 1)}"
    if isinstance(periodic, (str, bool)) or not isinstance(periodic, (Sequence, np.ndarray)):
        raise TypeError(f"Grid.periodic: got {periodic!r}, {wanted}")
    for axis, flag in enumerate(periodic):  # only bools: (2,) could mean "the third axis" or "true"
        if not isinstance(flag, (bool, np.bool_)):
            raise ValueError(f"Grid.periodic: entry {axis} is {flag!r}; {wanted}")
    return tuple(bool(flag) for flag in periodic)


def check_nodes(nodes: np.ndarray, axis: int, dtype: DType) -> None:
    """Refuse nodes of an axis that coincide up to rounding in ``dtype``."""
    largest = max(abs(nodes[0]), abs(nodes[-1]))
    if np.min(np.diff(nodes)) <= COINCIDING * np.finfo(dtype).eps * largest:
        lo, hi = float(nodes[0]), float(nodes[-1])
        raise ValueError(
            f"Grid: axis {axis} has {len(nodes)} points between {lo:.17g} and {hi:.17g}: the spacing is below the "
            f"rounding of its coordinates in {np.dtype(dtype)}; use fewer points, or measure the state from a "
            "point in the box"
        )


def check_count(shape: tuple[int, ...]) -> None:
    """Refuse more nodes than 32-bit indices can number."""
    size, n = math.prod(shape), len(shape)
    if size >= INDEXABLE:
        raise MemoryError(
            f"{' x '.join(map(str, shape))} = {size:,} nodes; 32-bit indices number fewer than {INDEXABLE:,}.\n"
            f"At most N = {math.floor((INDEXABLE - 1) ** (1 / n))} points per axis in {n}-D; {NO_GRID}."
        )


def check_parts(counts: tuple[int, ...], grid_shape: tuple[int, ...], caller: str, *choices: Any) -> None:
    """Check that the nodes, with these ``choices``, can be divided into these numbers of parts along the axes.

    Raises:
      ValueError: more numbers than the grid has axes, parts with too few nodes, or a choice that does not support
        parts.
    """
    if len(counts) > len(grid_shape):
        raise ValueError(
            f"{caller}: got a mesh of {len(counts)} axes, {counts}, wanted at most {len(grid_shape)}: axis i of "
            "the mesh divides axis i of the grid"
        )
    for axis, (size, count) in enumerate(zip(counts, grid_shape, strict=False)):
        if size > 1 and count // size < FEWEST:
            raise ValueError(
                f"{caller}: mesh divides the {count} points of axis {axis} into {size} parts; wanted at least {FEWEST} "
                f"points per part, so at most {count // FEWEST} parts"
            )
    for choice in choices:
        if not choice.in_parts:
            raise ValueError(
                f"{caller}: {choice!r} runs on one device; leave out mesh. A class that reads other nodes only by "
                "hjbjax.discretisation.stencil, and reduces by grid.layout, may set in_parts = True"
            )


def as_mesh(mesh: object, caller: str) -> Mesh:
    """The mesh with axes for ``shard_map``; a TypeError for anything else."""
    if not isinstance(mesh, Mesh):
        wanted = 'a jax.sharding.Mesh, as from jax.make_mesh((2,), ("x",))'
        raise TypeError(f"{caller}: mesh is {mesh!r}; wanted {wanted}")
    # shard_map's manual axes; axes of other types forbid slices
    return Mesh(mesh.devices, mesh.axis_names)
