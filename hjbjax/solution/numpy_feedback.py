"""Value and control of an exported solution, with NumPy only.

``Solution.export("feedback.npz")`` writes the file. This module reads it and imports nothing but NumPy and the standard
library, so that you can copy it next to the code of a robot:

    from numpy_feedback import load

    feedback = load("feedback.npz")
    u = feedback.control(x)  # control(t, x) after march

The answers agree with ``Solution.value_at`` and ``Solution.control_at`` up to rounding in float64.

File format, for other languages
--------------------------------
The file is an uncompressed zip archive of npy arrays. n is the number of axes, N_i the number of nodes along axis i, k
the number of stored times. [k] is a leading axis that exists only after ``march``. Arrays are in C order, float64 or
float32 unless another type is given.

    header                 uint8           JSON in UTF-8: format, version, names and units of states and controls, modes
    lo, hi                 (n,)            corners of the box
    periodic               (n,) bool       hi is the same point as lo; the last node is one spacing before hi
    uniform                (n,) bool       equal spacing h_i = (hi_i − lo_i)/M_i; M_i = N_i if periodic, else N_i − 1
    nodes0, nodes1, ...    (N_i,)          coordinates of the nodes of each axis
    value                  [k] N_0 ... N_n−1
    control, disturbance   [k] N_0 ... N_n−1, m    absent without controls or without an opponent; NaN: undefined
    enumerated             (2,) bool       True if the controls, and the disturbances, belong to a finite set
    switching              [k] N_0 ... N_n−1, int64    the mode after the controller's changes; absent without changes
    times                  (k,)            the stored times; absent for a stationary solution

With modes the first axis is the number of the mode, 0, 1, ..., and it is periodic.

A query at x does the following. (1) Wrap periodic entries into [lo, hi). (2) Find the cell: place = (x_i − lo_i)/h_i on
a uniform axis, c_i = floor(place), f_i = place − c_i; on another axis search the nodes. The next node of the last one
on a periodic axis is node 0. Round a place to the nearest integer if it differs by less than 1e-13 of the axis.
(3) Each of the 2^n corners b ∈ {0, 1}^n has the weight w_b = Π_i (f_i if b_i else 1 − f_i). After ``march`` the time is
one more axis before the others. (4) The value is Σ w_b V_b over the corners with w_b > 0. The control is the same mean
over the corners where the control is not NaN, divided by their total weight. An enumerated control and ``switching``
are not averaged: the corner with the largest weight decides, on ties the first one. Weights are tied if they differ by
less than a fraction of 32 ε Σ_i M_i max(1, |lo_i|/(hi_i − lo_i), |hi_i|/(hi_i − lo_i)), at most ½, with the machine
epsilon ε of the type of ``value``.
"""

import errno
import itertools
import json
import os
import stat
from typing import Any

import numpy as np

FORMAT, VERSION = "hjbjax.Feedback", 1
EPS = float(np.finfo(np.float64).eps)


class Feedback:
    """Value, control and disturbance between the nodes; see ``load``."""

    def __init__(self, header: dict, arrays: dict[str, np.ndarray]):
        self.names, self.modes, self.times = tuple(header["names"]), tuple(header["modes"]), arrays.get("times")
        self._arrays = arrays
        # after march the time is one more axis, before the axes of the grid
        lead = [] if self.times is None else [np.asarray(self.times, np.float64)]
        states = range(len(arrays["lo"]))
        self._nodes = lead + [np.asarray(arrays[f"nodes{axis}"], np.float64) for axis in states]
        lo, hi = (np.concatenate([[each[end] for each in lead], arrays[name]]) for end, name in ((0, "lo"), (-1, "hi")))
        periodic, uniform = (np.array([False] * len(lead) + arrays[name].tolist()) for name in ("periodic", "uniform"))
        self._lo, self._hi, self._span, self._periodic = lo, hi, np.where(hi > lo, hi - lo, 1), periodic
        self._counts = np.array([len(nodes) for nodes in self._nodes])
        self._last = self._counts - 1 + periodic  # intervals per axis
        self._scale = np.where(uniform, self._last, 1.0)  # the units of a position: cells, or the length of the axis
        self._top = np.where(hi > lo, self._scale, 0.0)  # the place of the last node; 0 if only one time is stored
        size = np.maximum(np.abs(lo), np.abs(hi)) / self._span
        self._slack = np.where(uniform, 8 * EPS * self._last * np.maximum(1, size), 64 * EPS * np.maximum(1, size))
        # at a midpoint an error e of a place changes the quotient of two weights by 4 e
        rounding = 32 * np.finfo(arrays["value"].dtype).eps * self._last * np.maximum(1, size)
        self._ties = min(float(rounding[len(lead) :].sum()), 0.5)
        self._wraps = bool(periodic.any())
        self._uneven = [axis for axis in range(len(lo)) if not uniform[axis]]
        self._corner = np.array(list(itertools.product((0, 1), repeat=len(lo))))
        self._strides = np.array([np.prod(self._counts[axis + 1 :], dtype=int) for axis in range(len(lo))])

    def value(self, *where: Any, mode: "str | int | None" = None, clamp: bool = False) -> Any:
        """V at states x, shape (..., n): ``value(x)``, or ``value(t, x)`` after ``march``; returns shape (...).

        Args:
          where: the states, after ``march`` preceded by the time, a number or an array of shape (...).
          mode: the name or the number of the mode, if the problem has modes; otherwise the states begin with it.
          clamp: use the nearest point of the box outside of it, and the nearest stored time; otherwise NaN there.
        """
        weights, nodes, hidden = self._corners(where, mode, clamp)
        found = self._at("value", nodes)[..., 0]
        found = (weights * np.where(weights > 0, found, 0)).sum(axis=-1)  # 0 · inf would be NaN
        return np.where(hidden, np.nan, found)[()]

    def control(self, *where: Any, mode: "str | int | None" = None, clamp: bool = False) -> np.ndarray:
        """The control, shape (..., m); arguments as for ``value``. NaN where it is undefined, as in the target."""
        return self._player("control", 0, where, mode, clamp)

    def disturbance(self, *where: Any, mode: "str | int | None" = None, clamp: bool = False) -> np.ndarray:
        """The opponent's action, shape (..., l); arguments as for ``value``."""
        return self._player("disturbance", 1, where, mode, clamp)

    def switching(self, *where: Any, mode: "str | int | None" = None, clamp: bool = False) -> Any:
        """The number of the mode to which the controller changes at once, or of the current mode; −1 outside.

        Arguments as for ``value``; the nearest node decides.
        """
        weights, nodes, hidden = self._corners(where, mode, clamp)
        found = self._at("switching", nodes)[..., 0]
        return np.where(hidden, -1, np.take_along_axis(found, self._nearest(weights), axis=-1)[..., 0])[()]

    def _player(self, name: str, number: int, where: tuple, mode: "str | int | None", clamp: bool) -> np.ndarray:
        """The actions of one player between the nodes."""
        weights, nodes, hidden = self._corners(where, mode, clamp)
        found = self._at(name, nodes)  # (..., corners, m)
        defined = ~np.isnan(found).any(axis=-1)
        weights = np.where(defined & ~hidden[..., None], weights, 0)
        if self._arrays["enumerated"][number]:
            answer = np.take_along_axis(found, self._nearest(weights)[..., None], axis=-2)[..., 0, :]
            return np.where(weights.any(axis=-1, keepdims=True), answer, np.nan)
        total = weights.sum(axis=-1, keepdims=True)
        answer = (weights[..., None] * np.where(defined[..., None], found, 0)).sum(axis=-2)
        return np.where(total > 0, answer, np.nan) / np.where(total > 0, total, 1)

    def _at(self, name: str, nodes: np.ndarray) -> np.ndarray:
        """The entries of an array at nodes with these numbers in C order, shape (*nodes.shape, m)."""
        if name not in self._arrays:
            raise ValueError(f"{name}: the exported solution has no {name}")
        return self._arrays[name].reshape(self._counts.prod(), -1)[nodes]

    def _corners(self, where: tuple, mode: "str | int | None", clamp: bool) -> "tuple[np.ndarray, ...]":
        """Weights (..., corners) and numbers of the nodes around each state, and True where the answer is NaN."""
        x = self._place(where, mode)
        place = (x - self._lo) / self._span * self._scale
        hidden = np.isnan(place).any(axis=-1)
        if not clamp:
            hidden |= ((place < -self._slack) | (place > self._top + self._slack)).any(axis=-1)
        place = np.fmin(np.fmax(place, 0), self._top)
        node = np.rint(place)  # a state on a node up to rounding must not read the values on both sides of it
        place = np.where(np.abs(node - place) <= self._slack, node, place)
        cell = np.minimum(place.astype(int), self._last - 1)
        fraction = place - cell
        for axis in self._uneven:
            cell[..., axis], fraction[..., axis] = self._search(self._nodes[axis], x[..., axis])
        weights = np.where(self._corner, fraction[..., None, :], 1 - fraction[..., None, :]).prod(axis=-1)
        return weights, (cell[..., None, :] + self._corner) % self._counts @ self._strides, hidden

    def _place(self, where: tuple, mode: "str | int | None") -> np.ndarray:
        """The states with the number of the mode and the time before them; periodic entries are wrapped."""
        marched = self.times is not None
        if len(where) != 1 + marched:
            raise ValueError(f"got {len(where)} arguments; call it with {'(t, x)' if marched else '(x)'}")
        x = np.asarray(where[-1], np.float64)
        if mode is not None:
            if mode not in self.modes and mode not in range(len(self.modes)):
                raise ValueError(f"got mode = {mode!r}, wanted one of {self.modes}")
            number = self.modes.index(mode) if isinstance(mode, str) else mode
            x = np.concatenate([np.full((*x.shape[:-1], 1), float(number)), x], axis=-1)
        if x.ndim == 0 or x.shape[-1] != len(self.names):
            names = ", ".join(self.names[mode is not None :])
            raise ValueError(f"got states of shape {x.shape}; wanted one entry per axis: {names}")
        if self.modes and not np.isin(x[..., 0], np.arange(len(self.modes))).all():
            raise ValueError(
                f"got the modes {x[..., 0].tolist()}, wanted whole numbers from 0 to {len(self.modes) - 1}"
            )
        if marched:
            t = np.asarray(where[0], np.float64)
            shape = np.broadcast_shapes(t.shape, x.shape[:-1])
            x = np.concatenate(
                [np.broadcast_to(t[..., None], (*shape, 1)), np.broadcast_to(x, (*shape, x.shape[-1]))], -1
            )
        if self._wraps:
            x = np.where(self._periodic & np.isinf(x), np.nan, x)
            beyond = self._periodic & ~((x >= self._lo) & (x < self._hi))
            moved = self._lo + np.mod(np.where(beyond, x - self._lo, 0), self._span)
            x = np.where(beyond, np.where(moved >= self._hi, self._lo, moved), x)
        return x

    def _nearest(self, weights: np.ndarray) -> np.ndarray:
        """The first corner with the largest weight, shape (..., 1); at a midpoint rounding must not decide."""
        largest = weights.max(axis=-1, keepdims=True)
        return np.argmax(weights * (1 + self._ties) >= largest, axis=-1)[..., None]

    def _search(self, nodes: np.ndarray, x: np.ndarray) -> "tuple[np.ndarray, np.ndarray]":
        """The node below x and the fraction of the distance to the next node, on an axis with unequal spacings."""
        cell = np.maximum(np.minimum(np.searchsorted(nodes, x, side="right") - 1, len(nodes) - 2), 0)
        width = nodes[np.minimum(cell + 1, len(nodes) - 1)] - nodes[cell]  # zero if only one time is stored
        return cell, np.fmin(np.fmax((x - nodes[cell]) / np.where(width > 0, width, 1), 0), 1)


def load(path: Any) -> Feedback:
    """The feedback in a file written by ``Solution.export``; never runs code from the file.

    Raises:
      ValueError: the file is damaged, or was not written by ``export``, or by a newer version.
      OSError: the file cannot be read.
    """
    try:
        header, arrays = _read(path)
        if header["format"] == FORMAT and header["version"] <= VERSION:
            _check(header, arrays)
            return Feedback(header, arrays)
        found = f"{header['format']}, version {header['version']}"
    except OSError as error:
        if error.errno not in (None, errno.EINVAL):  # offsets in a damaged file may lie before its start
            raise
        raise ValueError(f"{path}: damaged ({error})") from error
    except Exception as error:  # zipfile, json and NumPy raise a dozen types for damaged bytes
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise ValueError(f"{path}: damaged, or not a file written by Solution.export ({reason})") from error
    raise ValueError(f"{path}: got {found[:200]}; wanted {FORMAT} up to version {VERSION}, from Solution.export")


def _read(path: Any) -> "tuple[dict, dict[str, np.ndarray]]":
    """The header and all arrays of a file."""
    if not stat.S_ISREG(os.stat(path).st_mode) and not os.path.isdir(path):  # opening a pipe would block indefinitely
        raise ValueError("it is not an ordinary file")
    with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
        size = os.fstat(stream.fileno()).st_size
        if (claimed := sum(member.file_size for member in file.zip.infolist())) > size:
            raise ValueError(f"it claims {claimed} bytes of arrays and is {size} bytes long")
        return json.loads(file["header"].tobytes()), {name: file[name] for name in file.files}


def _check(header: dict, arrays: "dict[str, np.ndarray]") -> None:
    """Refuse arrays with other names, shapes or types than the format has, which would be another feedback."""
    if set(arrays) - {"header"} != set(header["arrays"]):
        raise ValueError(f"its arrays are {sorted(arrays)}, and its header lists {header['arrays']}")
    names, modes = header["names"], header["modes"]
    if not all(isinstance(name, str) for name in (*names, *modes)):
        raise ValueError(f"its axes and modes are {names} and {modes}, wanted text")
    n = len(names)
    counts = tuple(len(arrays[f"nodes{axis}"]) for axis in range(n))
    lead = (len(arrays["times"]),) if "times" in arrays else ()
    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        **dict.fromkeys(("lo", "hi"), ("f", (n,))), **dict.fromkeys(("periodic", "uniform"), ("b", (n,))),
        "enumerated": ("b", (2,)), "value": ("f", lead + counts), "switching": ("i", lead + counts),
        "times": ("f", lead), **{f"nodes{axis}": ("f", (count,)) for axis, count in enumerate(counts)},
    }  # fmt: skip
    for name in ("control", "disturbance"):
        wanted[name] = "f", (*lead, *counts, *np.shape(arrays.get(name, 0))[-1:])
    optional = {"control", "disturbance", "switching", "times"}
    if (wrong := set(header["arrays"]) ^ set(wanted)) - (optional - set(header["arrays"])):
        raise ValueError(f"it has the wrong arrays {sorted(wrong)}")
    for name, (kind, shape) in wanted.items():
        found = arrays.get(name)
        if found is not None and (found.dtype.kind != kind or found.shape != shape):
            raise ValueError(f"{name} is {found.dtype} of shape {found.shape}, wanted kind {kind!r} of shape {shape}")
    if modes and counts[0] != len(modes):
        raise ValueError(f"it has {len(modes)} modes and {counts[0]} values of the mode")
