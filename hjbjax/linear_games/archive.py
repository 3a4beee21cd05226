"""Conversion of a ``HopfSolution`` to the header and the arrays of a result file, and back."""

from typing import Any

import numpy as np

from hjbjax.linear_games.convex import Largest, Quadratic
from hjbjax.linear_games.linear_dynamics import LinearGame
from hjbjax.problem.sets import Ball, Box, Finite, Simplex
from hjbjax.solution.files import FileError

MATRICES = ("drift", "constant", "own", "other")
SETS = ("own_set", "other_set", "effective")


def game_contents(game: LinearGame) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a game.

    Raises:
      ValueError: the terminal cost is a function of the user's, which a file cannot hold.
    """
    header: dict[str, Any] = {name: getattr(game, name) for name in ("exact", "negated", "playing")}
    arrays = {name: np.asarray(getattr(game, name), float) for name in MATRICES}
    for name in SETS:
        header[name], own = _of_set(getattr(game, name))
        arrays |= {f"{name}.{key}": np.asarray(value, float) for key, value in own.items()}
    terminal = game.terminal
    if isinstance(terminal, Largest):
        header["terminal"] = {"kind": "largest", "dim": terminal.dim, "norms": len(terminal.norms)}
        own = {"rows": terminal.rows, "offsets": terminal.offsets}
        for k, norm in enumerate(terminal.norms):
            own |= {f"{part}{k}": value for part, value in zip(("matrix", "center", "offset"), norm, strict=True)}
    elif isinstance(terminal, Quadratic):
        header["terminal"] = {"kind": "quadratic", "dim": terminal.dim}
        own = {"matrix": terminal.matrix, "slope": terminal.slope, "offset": terminal.offset}
    else:
        raise ValueError(
            "HopfSolution.save: got a terminal cost made by hjb.convex.smooth, which a file cannot hold; save\n"
            "solution.on_grid(grid), or build the solution again"
        )
    return header, arrays | {f"terminal.{key}": np.asarray(value, float) for key, value in own.items()}


def rebuild(header: dict, arrays: dict[str, np.ndarray]) -> LinearGame:
    """The game in a file.

    Raises:
      FileError: the arrays do not fit each other.
    """
    described = header["terminal"]
    n = int(described["dim"])
    own = {key.partition(".")[2]: value for key, value in arrays.items() if key.startswith("terminal.")}
    if arrays["drift"].shape != (n, n):
        raise FileError(f"its matrix has shape {arrays['drift'].shape}, wanted ({n}, {n})")
    terminal: Any
    if described["kind"] == "quadratic":
        terminal = Quadratic(n, own["matrix"], own["slope"], float(own["offset"]))
    else:
        norms = [
            (own[f"matrix{k}"], own[f"center{k}"], float(own[f"offset{k}"])) for k in range(int(described["norms"]))
        ]
        terminal = Largest(n, own["rows"], own["offsets"], tuple(norms))
    sets = [_to_set(header[name], name, arrays) for name in SETS]
    a, c, b, d = (arrays[name] for name in MATRICES)
    flags = {name: header[name] for name in ("exact", "negated", "playing")}
    return LinearGame(a, c, b, sets[0], d, sets[1], sets[2], terminal, **flags)


def _of_set(admissible: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Description and arrays of an admissible set."""
    kind = type(admissible).__name__
    if isinstance(admissible, Box):
        return {"kind": kind}, {"lo": admissible.lo, "hi": admissible.hi}
    if isinstance(admissible, Ball):
        return {"kind": kind, "dim": admissible.dim}, {"radius": admissible.radius}
    if isinstance(admissible, Simplex):
        return {"kind": kind, "dim": admissible.dim, "at_most": admissible.at_most}, {"total": admissible.total}
    return {"kind": kind}, {"points": admissible.points}


def _to_set(described: dict[str, Any], name: str, arrays: dict[str, np.ndarray]) -> Any:
    """The admissible set of a description."""
    kinds = {"Box": Box, "Ball": Ball, "Simplex": Simplex, "Finite": Finite}
    if described.get("kind") not in kinds:
        raise FileError(f"its set {name} is of the unknown kind {described.get('kind')!r}")
    own = {key.partition(".")[2]: value for key, value in arrays.items() if key.partition(".")[0] == name}
    options = {key: value for key, value in described.items() if key != "kind"}
    return kinds[described["kind"]](**own, **options)
