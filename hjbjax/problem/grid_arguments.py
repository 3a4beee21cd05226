"""What a Grid is given, checked: corners, counts, flags, stretchings and the kinds of its ends."""

import difflib
from collections.abc import Sequence

import numpy as np

from hjbjax.problem.pytree import numbers
from hjbjax.problem.stretching import Sinh
from hjbjax.problem.types import Array

EDGES = ("projected", "constrained", "open")  # names, as they carry no numbers: static, hashable, saved as they are
Ends = tuple[str, str] | None  # of an axis: the kinds of its lower and its upper end; none where it is periodic


def check_stretch(stretch: tuple, periodic: tuple[bool, ...]) -> None:
    """Refuse stretchings of another type, and those of periodic axes."""
    for axis, (stretching, cyclic) in enumerate(zip(stretch, periodic, strict=True)):
        if stretching is not None and not isinstance(stretching, Sinh):
            raise TypeError(f"Grid.stretch: entry {axis} is {stretching!r}; wanted Sinh(strength, center) or None")
        if stretching is not None and cyclic:
            raise ValueError(f"Grid.stretch: axis {axis} is periodic; only an axis with ends can be stretched")


def kinds_of_ends(edges: object, periodic: tuple[bool, ...], shape: tuple[int, ...]) -> tuple[Ends, ...]:
    """The kinds of both ends of every axis, checked."""
    if edges is None or isinstance(edges, str):
        _kind(edges, "every end")
        edges = [None if cyclic else edges for cyclic in periodic]
    if not isinstance(edges, Sequence) or len(edges) != len(periodic):
        pair = '(("open", "constrained"),)' if len(periodic) == 1 else '("open", ("projected", "constrained"))'
        raise ValueError(
            f"Grid.edges: got {edges!r} for {len(periodic)} axes; wanted a name for all, or one entry an axis: a name "
            f"or a pair (lower end, upper end), as in {pair}"
        )
    return tuple(_ends(entry, axis, periodic[axis], shape[axis]) for axis, entry in enumerate(edges))


def _ends(entry: object, axis: int, cyclic: bool, count: int) -> Ends:
    """The kinds of the two ends of one axis."""
    if cyclic and entry is not None:
        raise ValueError(f"Grid.edges: axis {axis} is periodic and has no ends; got {entry!r} there, wanted None")
    if cyclic:
        return None
    # a name stands for both ends; as a Sequence it would be taken for a list of letters
    pair = (entry, entry) if entry is None or isinstance(entry, str) else entry
    if not isinstance(pair, Sequence) or len(pair) != 2:
        raise ValueError(f"Grid.edges: axis {axis} has {entry!r}; wanted a name or a pair (lower end, upper end)")
    lower, upper = (_kind(name, f"axis {axis}") for name in pair)
    if "open" in (lower, upper) and count < 3:  # a parabola goes on beyond the end
        raise ValueError(f"Grid.edges: axis {axis} has {count} points; an open end continues the last three")
    return lower, upper


def _kind(name: object, where: str) -> str:
    """The kind of one end by its name; "projected" without one."""
    if name is None:
        return "projected"
    if not isinstance(name, str) or name not in EDGES:
        near = difflib.get_close_matches(str(name), EDGES, 1, 0.4)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"Grid.edges: got {name!r} for {where}; wanted one of {', '.join(map(repr, EDGES))}{hint}")
    return name


def corner(value: object, name: str) -> Array:
    """One corner of the box: a number an axis."""
    corner = numbers(value, f"Grid.{name}")
    if np.ndim(corner) != 1 or np.size(corner) == 0:
        raise ValueError(f"Grid.{name}: got {value!r}, wanted a list of numbers, one an axis")
    return corner


def counts(shape: object) -> tuple[int, ...]:
    """The points of every axis, at least two."""
    if isinstance(shape, str) or not isinstance(shape, (Sequence, np.ndarray)):
        raise TypeError(f"Grid.shape: got {shape!r}, wanted a tuple of integers, one an axis")
    for axis, count in enumerate(shape):
        # True counts as 1 to Python; given here it was most likely meant for ``periodic``
        if isinstance(count, (bool, np.bool_)) or not isinstance(count, (int, np.integer)):
            raise TypeError(f"Grid.shape: axis {axis} has {count!r} points; wanted an integer")
        if count < 2:
            raise ValueError(f"Grid.shape: axis {axis} has {count} points; wanted at least 2")
    return tuple(int(count) for count in shape)


def periodic_flags(periodic: object, n: int) -> tuple[bool, ...]:
    """One flag for each of the n axes, True where it is periodic; None stands for no such axis."""
    if periodic is None:
        return (False,) * n
    wanted = f"wanted one bool an axis (not axis numbers), as in {(True,) + (False,) * (n - 1)}"
    if isinstance(periodic, (str, bool)) or not isinstance(periodic, (Sequence, np.ndarray)):
        raise TypeError(f"Grid.periodic: got {periodic!r}, {wanted}")
    for axis, flag in enumerate(periodic):  # bools and no numbers: (2,) would else be "the third axis" or "true"
        if not isinstance(flag, (bool, np.bool_)):
            raise ValueError(f"Grid.periodic: entry {axis} is {flag!r}; {wanted}")
    return tuple(bool(flag) for flag in periodic)
