"""The bounds as functions, and ``Enclosure``, the result of ``enclose``, with its files."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np

from hjbjax.enclosure.interpolant import Spline, axis_table
from hjbjax.enclosure.levels import Levels
from hjbjax.problem.grid import Grid
from hjbjax.problem.types import Numbers
from hjbjax.solution import archive, files
from hjbjax.solution.status import Status

SIDES = ("lower", "upper")


@dataclasses.dataclass(frozen=True)
class Bound:
    """One bound: the best of several functions of splines.

    Attributes:
      spline: the cells of the grid.
      coefficients: of every spline, each (*grid).
      levels: the function of every spline that is a bound.
      sign: 1 for a lower and −1 for an upper bound, before a change of sign.
      caps: the least and the largest bound in every cell, (2, *cells); a bound is first raised to the least one, and
        then lowered to the largest one. ``None`` without a target.
      negated: True if minus this is the bound, for rewards.
    """

    spline: Spline
    coefficients: tuple[np.ndarray, ...]
    levels: tuple[Levels, ...]
    sign: int
    caps: np.ndarray | None = None
    negated: bool = False

    def at(self, states: np.ndarray) -> np.ndarray:
        """The bound at states (count, n) inside the box, rounded to its side."""
        best, places = np.full(len(states), -self.sign * np.inf), self.spline.at(states)
        for values, levels in zip(self.coefficients, self.levels, strict=True):
            found = levels.at(places.values(values))
            best = np.maximum(best, found) if self.sign > 0 else np.minimum(best, found)
        if self.caps is not None:
            least, largest = (each[self.spline.index(states)] for each in self.caps)
            best = np.minimum(np.maximum(best, least), largest)
        return -best if self.negated else best

    def with_candidate(self, coefficients: np.ndarray, levels: Levels) -> "Bound":
        """The best of this bound and a function of one more spline."""
        return dataclasses.replace(self, coefficients=(*self.coefficients, coefficients), levels=(*self.levels, levels))

    def negative(self) -> "Bound":
        """Minus the bound, which is a bound from the other side."""
        return dataclasses.replace(self, negated=not self.negated)


def evaluate_in_box(
    function: Callable[[np.ndarray], np.ndarray], grid: Grid, x: Numbers | Sequence, outside: float | bool, caller: str
) -> np.ndarray:
    """A function at states in the box of a grid, shape (...).

    Args:
      function: takes states (count, n) in the box and returns (count,).
      grid: the grid. Along a periodic axis all states are in the box.
      x: the states, shape (n,) or (..., n).
      outside: the result at states outside the box.
      caller: the beginning of a message.
    """
    states, n = np.asarray(x, float), grid.ndim
    if states.ndim == 0 or states.shape[-1] != n:
        raise ValueError(f"{caller}: got states of shape {states.shape}, wanted (..., {n})")
    flat = states.reshape(-1, n)
    lo, hi = np.asarray(grid.lo, float), np.asarray(grid.hi, float)
    cyclic = np.array(grid.periodic)
    flat = np.where(cyclic & ((flat < lo) | (flat > hi)), lo + np.mod(flat - lo, hi - lo), flat)
    inside = np.all((flat >= lo) & (flat <= hi), axis=-1)
    found = np.full(len(flat), outside)
    if np.any(inside):
        found[inside] = function(flat[inside])
    return found.reshape(states.shape[:-1])


def spline_arrays(spline: Spline) -> dict[str, np.ndarray]:
    """The arrays of a file from which ``spline_of`` makes the same spline."""
    # a proof holds for these very numbers, which another machine may compute differently
    return {f"axis{axis}": table.at for axis, table in enumerate(spline.tables)}


def spline_of(arrays: Mapping[str, np.ndarray], periodic: Sequence[bool]) -> Spline:
    """The spline with the arrays of a file."""
    return Spline(tuple(axis_table(arrays[f"axis{k}"], cyclic) for k, cyclic in enumerate(periodic)))


@dataclasses.dataclass(frozen=True, eq=False)
class Enclosure(files.Saved):
    """Two functions between which the value of the continuous problem lies; made by ``enclose``.

    Args:
      grid: the grid.
      lower: the lower bound at the nodes, shape (*grid), in cost units.
      upper: the upper bound at the nodes. Without a discount it may be infinite, and for rewards the lower one.
      status: CONVERGED if the mean width is at most ``tol`` times the range of V, otherwise MAX_STEPS. The bounds hold
        in both cases.
      message: the problem whose value is bounded, and the mean width of the bounds.
      stats: "seconds", "bytes" (the estimated memory) and "corrections".
      remaining: e^{−βT} at the nodes, shape (*grid), where T is a lower bound of the time until a path can meet a
        projected end. If the problem continues beyond the box, its value differs from the value between walls by at
        most this factor times the largest difference at the ends. Zero without projected ends.
        Without a discount it is zero where a path that meets an end costs more than the upper bound, so that the ends
        do not matter, and one at the other nodes.
      required: the shift that the cell around each node requires for the lower and for the upper bound before the
        corrections, shape (2, *grid), in cost units; without a discount the defect relative to the running cost. More
        nodes help most where it is large.
      bounds: the lower and the upper bound as functions.
    """

    FORMAT = "hjbjax.Enclosure"
    KINDS: ClassVar = {
        "grid": (dict,), "code": (int,), "message": (str,), "stats": (dict,), "splines": (list,), "levels": (list,),
        "negated": (bool,), "capped": (bool,),
    }  # fmt: skip

    grid: Grid
    lower: np.ndarray
    upper: np.ndarray
    status: Status
    message: str
    stats: dict
    remaining: np.ndarray
    required: np.ndarray
    bounds: tuple[Bound, Bound] = dataclasses.field(repr=False)

    @property
    def width(self) -> np.ndarray:
        """The upper minus the lower bound at the nodes, shape (*grid)."""
        return self.upper - self.lower

    def lower_at(self, x: Numbers | Sequence) -> Any:
        """The lower bound between the nodes.

        Args:
          x: states, shape (n,) or (..., n).

        Returns:
          Shape (...), in cost units; NaN outside the box.
        """
        return evaluate_in_box(self.bounds[0].at, self.grid, x, np.nan, "Enclosure.lower_at")

    def upper_at(self, x: Numbers | Sequence) -> Any:
        """The upper bound between the nodes; see ``lower_at``."""
        return evaluate_in_box(self.bounds[1].at, self.grid, x, np.nan, "Enclosure.upper_at")

    def __repr__(self) -> str:
        return f"Enclosure({self.status}, largest width {np.max(self.width):.3g} on {self.grid.size} nodes)"

    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        header = {
            "grid": archive.about_grid(self.grid), "code": int(self.status), "message": self.message,
            "stats": self.stats, "splines": [len(each.levels) for each in self.bounds],
            "levels": [len(each.levels[0].edges) for each in self.bounds], "negated": self.bounds[0].negated,
            "capped": self.bounds[0].caps is not None,
        }  # fmt: skip
        names = ("lower", "upper", "remaining", "required")
        arrays = {"lo": self.grid.lo, "hi": self.grid.hi, **{name: getattr(self, name) for name in names}}
        arrays |= spline_arrays(self.bounds[0].spline)
        for name, bound in zip(SIDES, self.bounds, strict=True):
            arrays[f"{name}_coefficients"] = np.stack(bound.coefficients)
            parts = [(each.edges, each.values, each.slopes) for each in bound.levels]
            arrays[f"{name}_levels"] = np.array(parts)
            if bound.caps is not None:
                arrays[f"{name}_caps"] = bound.caps
        return header, arrays

    @staticmethod
    def _plan(header: dict) -> dict[str, files.Expected]:
        """The arrays of a file; their shapes follow from its grid and the number of splines."""
        shape, cyclic = archive.shape_of(header["grid"]), header["grid"]["periodic"]
        shapes: dict[str, tuple[int, ...]] = {name: (len(shape),) for name in ("lo", "hi")}
        shapes |= {**dict.fromkeys(("lower", "upper", "remaining"), shape), "required": (2, *shape)}
        shapes |= {f"axis{axis}": (count + bool(cyclic[axis]),) for axis, count in enumerate(shape)}
        for name, count, levels in zip(SIDES, header["splines"], header["levels"], strict=True):
            shapes |= {f"{name}_coefficients": (count, *shape), f"{name}_levels": (count, 3, levels)}
            if header["capped"]:
                shapes[f"{name}_caps"] = (2, *(n + bool(each) for n, each in zip(shape, cyclic, strict=True)))
        return {name: files.Expected((each,), (np.float64,), optional=False) for name, each in shapes.items()}

    @classmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The enclosure with a header and arrays of a file."""
        grid = archive.grid_of(header["grid"], arrays["lo"], arrays["hi"])
        spline = spline_of(arrays, grid.periodic)
        lower, upper = (
            Bound(
                spline, tuple(arrays[f"{name}_coefficients"]),
                tuple(Levels(each[0], each[1], each[2], sign) for each in arrays[f"{name}_levels"]), sign,
                arrays.get(f"{name}_caps"), header["negated"],
            )
            for name, sign in zip(SIDES, (-1, 1) if header["negated"] else (1, -1), strict=True)
        )  # fmt: skip
        return cls(
            grid, arrays["lower"], arrays["upper"], Status(header["code"]), header["message"], header["stats"],
            arrays["remaining"], arrays["required"], (lower, upper),
        )  # fmt: skip
