"""The value of a network with its problem, ``NeuralSolution``: lookups, files, and errors on held-out data."""

import functools
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.hamiltonian import pointwise
from hjbjax.hamiltonian.pointwise import Rule
from hjbjax.neural.ansatz import HorizonAnsatz, RestAnsatz, TargetAnsatz
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import as_jax, cast, is_traced, pytree_dataclass
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array, Number, Numbers, Scalar, State
from hjbjax.solution import files
from hjbjax.solution.placement import FileError, Path
from hjbjax.solution.status import Status
from hjbjax.tracing import checks, closures

BLOCKS = (1, 32, 1024)  # the numbers of states of one compiled program
# the axes of the arrays of a file: n states, k nodes in time, and r entries of a quadratic function; others are numbers
AXES = {
    **dict.fromkeys(("lo", "hi", "state", "costate", "size", "center"), "n"),
    **dict.fromkeys(("matrix", "norm"), "nn"), "nodes": "k", "change": "kr", "rates": "kr",
}  # fmt: skip
MESSAGES = {
    Status.CONVERGED: "The error on held-out data is below tol.",
    Status.MAX_STEPS: "Reached the number of steps with a held-out error above tol. Raise steps, or pass guess=.",
    Status.NONFINITE: "The held-out error became NaN or infinite; the best weights are kept. Lower rate.",
    Status.INTERRUPTED: "The training was interrupted; the best weights are kept. Continue with guess=.",
    Status.TIME_LIMIT: "Reached time_limit; the best weights are kept. Continue with guess=.",
}


@pytree_dataclass(static=("rule",), host=("code", "validation", "history", "seconds"))
class NeuralSolution(files.Saved):
    """A value given by a network, made by ``neural.solve`` and ``neural.deep_bsde``.

    It can be called like a feedback and passed to ``simulate`` and ``greedy_feedback``. Results are float64 NumPy for
    numbers; under ``jit``, ``vmap`` and ``grad`` they follow the dtype of the state.

    Args:
      ansatz: the network, and the data of the problem that it meets.
      lo: lower corner of the box of the training states, shape (n,).
      hi: upper corner, shape (n,).
      problem: the problem; ``None`` for a file that was loaded without it.
      rule: the method for the minimum of the Hamiltonian.
      code: a ``Status`` number; host data, like the arguments below.
      validation: errors on held-out data by name; see the function that made the solution.
      history: the held-out error before training and after every 25 steps, shape (k,).
      seconds: the duration.
    """

    FORMAT = "hjbjax.NeuralSolution"
    KINDS: ClassVar = {
        "ansatz": (str,), "fields": (list,), "layers": (int,), "status": (int,), "validation": (dict,),
        "seconds": files.REAL, "quadratic": (bool,),
    }  # fmt: skip

    ansatz: Any
    lo: Any
    hi: Any
    problem: Problem | None
    rule: Rule | None = None
    code: int = int(Status.CONVERGED)
    validation: Any = None
    history: Any = None
    seconds: float = 0.0

    @property
    def status(self) -> Status:
        """CONVERGED, MAX_STEPS, NONFINITE, INTERRUPTED or TIME_LIMIT."""
        return Status(int(self.code))

    @property
    def message(self) -> str:
        """The outcome and the remedy in one or two sentences."""
        return MESSAGES.get(self.status, self.status.message)

    @property
    def ndim(self) -> int:
        """The number of states n."""
        return np.shape(self.lo)[-1]

    @property
    def horizon(self) -> Any:
        """T, in units of time; ``None`` for a stationary value."""
        return self.ansatz.horizon if isinstance(self.ansatz, HorizonAnsatz) else None

    @property
    def timed(self) -> bool:
        """True over a horizon, with methods that take (t, x) instead of (x)."""
        return isinstance(self.ansatz, HorizonAnsatz)

    def value_at(self, *where: Numbers | Sequence, extrapolate: bool = False) -> Any:
        """V: ``value_at(x)``, or ``value_at(t, x)`` over a horizon.

        Args:
          where: states x, shape (n,) or (..., n); over a horizon preceded by times, a number or shape (...).
          extrapolate: evaluate the network also outside the box of the training; otherwise NaN there.

        Returns:
          Shape ``x.shape[:-1]``, in cost units.

        Raises:
          ValueError: states of the wrong length, or a missing time.
        """
        return self._evaluate("value_at", where, extrapolate)

    def costate_at(self, *where: Numbers | Sequence, extrapolate: bool = False) -> Any:
        """DV, the exact gradient of ``value_at``, shape ``x.shape[:-1] + (n,)``; arguments as for ``value_at``."""
        return self._evaluate("costate_at", where, extrapolate)

    def control_at(self, *where: Numbers | Sequence, extrapolate: bool = True) -> Any:
        """The control that minimises the Hamiltonian, shape ``x.shape[:-1] + (m,)``.

        Paths from the box may leave it for a short time, so the network is also evaluated outside, unless
        ``extrapolate`` is False.

        Raises:
          ValueError: the problem has no controls, or the solution was loaded without its problem.
        """
        if self.problem is None:
            raise ValueError("NeuralSolution.control_at: the problem is missing; use load(path, problem)")
        if self.problem.controls is None:
            raise ValueError("NeuralSolution.control_at: the problem has no controls")
        return self._evaluate("control_at", where, extrapolate)

    def __call__(self, *where: Numbers | Sequence) -> Any:
        """The control, as ``control_at``."""
        return self.control_at(*where)

    def _evaluate(self, name: str, where: tuple, extrapolate: bool) -> Any:
        """One of the lookups at states (..., n)."""
        timed, n = self.horizon is not None, self.ndim
        if len(where) != 1 + timed:
            wanted = "(t, x): the value depends on time" if timed else "(x): the value does not depend on time"
            raise ValueError(f"NeuralSolution.{name}: got {len(where)} arguments, wanted {wanted}")
        if self.problem is None and not isinstance(self.ansatz, RestAnsatz):
            raise ValueError(
                f"NeuralSolution.{name}: the terminal cost or the target is missing; pass the problem to load"
            )
        traced = is_traced(self, where)
        xp: Any = jnp if traced else np
        t: Any
        x: Any
        t, x = where if timed else (0.0, where[0])
        x = xp.asarray(x) if traced else np.asarray(x, float)
        if not x.shape or x.shape[-1] != n:
            raise ValueError(f"NeuralSolution.{name}: got states of shape {x.shape}, wanted (..., {n})")
        x = x if xp.issubdtype(x.dtype, xp.floating) else x.astype(float)
        t = xp.asarray(t, x.dtype)
        shape = np.broadcast_shapes(t.shape, x.shape[:-1])
        t, x = xp.broadcast_to(t, shape).reshape(-1), xp.broadcast_to(x, (*shape, n)).reshape(-1, n)
        if traced:
            found: Any = _lanes(as_jax(self), name, extrapolate, t, x)
        else:
            with own_settings(x64=True):
                found = _in_blocks(cast(self, np.float64), name, extrapolate, t, x)
        return found.reshape((*shape, *found.shape[1:]))

    @classmethod
    def load(cls, path: Path, problem: Problem | None = None) -> "NeuralSolution":
        """The solution in a file written by ``save``.

        Args:
          path: the file.
          problem: the problem, which a file cannot hold. Needed for controls, and for values over a horizon or to a
            target, which contain the terminal cost or the target.

        Raises:
          FileError: the file is missing, damaged or foreign.
        """
        found = super().load(path)
        return found if problem is None else with_problem(found, problem)

    def _contents(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        fields = {
            name: each
            for name, each in vars(self.ansatz).items()
            if name not in ("weights", "quadratic") and each is not None
        }
        arrays = {name: np.asarray(each, float) for name, each in fields.items()}
        for i, (matrix, bias) in enumerate(self.ansatz.weights):
            arrays |= {f"matrix{i}": np.asarray(matrix, float), f"bias{i}": np.asarray(bias, float)}
        header = {
            "ansatz": type(self.ansatz).__name__, "fields": list(fields), "layers": len(self.ansatz.weights),
            "status": int(self.code), "validation": self.validation or {}, "seconds": self.seconds,
            "quadratic": not isinstance(self.ansatz, RestAnsatz) or self.ansatz.quadratic,
        }  # fmt: skip
        arrays |= {"lo": np.asarray(self.lo, float), "hi": np.asarray(self.hi, float)}
        history = np.zeros(0) if self.history is None else np.asarray(self.history, float)
        return header, {**arrays, "history": history}

    @staticmethod
    def _plan(header: dict) -> dict[str, files.Expected]:
        """The arrays of a file."""
        shapes = tuple((None,) * axes for axes in range(3))
        names = [*header["fields"], "lo", "hi", "history"]
        if header["layers"] > len(header["arrays"]):  # before a loop over a number that may be anything
            raise FileError(f"its {len(header['arrays'])} arrays cannot be {header['layers']} layers")
        for i in range(header["layers"]):
            names += [f"matrix{i}", f"bias{i}"]
        return {name: files.Expected(shapes, (np.float64,), optional=False) for name in names}

    @classmethod
    def _from_file(cls, header: dict, arrays: dict[str, np.ndarray]) -> Self:
        """The solution with the header and the arrays of a file."""
        kinds: dict[str, Any] = {kind.__name__: kind for kind in (RestAnsatz, HorizonAnsatz, TargetAnsatz)}
        if header["ansatz"] not in kinds:
            raise FileError(f"its ansatz {header['ansatz']!r} is not known here: update hjbjax")
        _check_shapes(header, arrays)
        weights = tuple((arrays[f"matrix{i}"], arrays[f"bias{i}"]) for i in range(header["layers"]))
        options: dict[str, Any] = {} if header["quadratic"] else {"quadratic": False}
        ansatz = kinds[header["ansatz"]](weights, **{name: arrays[name] for name in header["fields"]}, **options)
        validation = {name: float(value) for name, value in header["validation"].items()}
        return cls(
            ansatz, arrays["lo"], arrays["hi"], None, None, int(Status(header["status"])), validation,
            arrays["history"], float(header["seconds"]),
        )  # fmt: skip

    def __repr__(self) -> str:
        over = "" if self.horizon is None or is_traced(self.horizon) else f" over {float(self.horizon):g}"
        return f"NeuralSolution({self.status}, {self.ndim} states{over})"

    def __str__(self) -> str:
        lines = [f"{self.status}: {self.message}"]
        lines += [f"  {name.replace('_', ' '):<16} {value:.4g}" for name, value in (self.validation or {}).items()]
        return "\n".join([*lines, f"  {'seconds':<16} {self.seconds:.3g}"])


def _check_shapes(header: dict, arrays: dict[str, np.ndarray]) -> None:
    """Refuse arrays of a file whose shapes do not fit each other.

    Raises:
      FileError: one of them does not.
    """
    n = arrays["lo"].size
    lengths = {"n": n, "k": arrays["nodes"].size if "nodes" in header["fields"] else 0, "r": 1 + n + n**2}
    wanted = {name: tuple(lengths[axis] for axis in AXES.get(name, "")) for name in ("lo", "hi", *header["fields"])}
    inputs = n + 2 * (header["ansatz"] == HorizonAnsatz.__name__)
    for i in range(header["layers"]):
        wanted |= {f"matrix{i}": (inputs, arrays[f"bias{i}"].size), f"bias{i}": (arrays[f"bias{i}"].size,)}
        inputs = arrays[f"bias{i}"].size
    if header["layers"] < 1 or inputs != 1:
        raise FileError(f"its network has {header['layers']} layers and {inputs} outputs, wanted one output")
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise FileError(f"its array {name!r} has shape {arrays[name].shape}, wanted {shape}")


def weights_of_guess(guess: object, inputs: int, layers: Sequence[int], name: str) -> Any:
    """The weights of a guess.

    Raises:
      TypeError: it is not a NeuralSolution.
      ValueError: its layers do not fit.
    """
    if not isinstance(guess, NeuralSolution):
        raise TypeError(f"{name}: got guess = {type(guess).__name__}, wanted a NeuralSolution")
    weights = guess.ansatz.weights
    found = [np.shape(matrix)[0] for matrix, _ in weights]
    if found != [inputs, *layers]:
        raise ValueError(
            f"{name}: the guess has layers {found[1:]} of {found[0]} inputs,\nwanted {list(layers)} of {inputs}"
        )
    return weights


def numbers_of_guess(guess: object) -> np.ndarray | None:
    """All numbers of the ansatz of a guess, as its identity in a checkpoint; None without a guess."""
    if not isinstance(guess, NeuralSolution):
        return None
    return np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(guess.ansatz)])


def value_of(solution: NeuralSolution, t: Number, x: State) -> Scalar:
    """V at one state."""
    return solution.ansatz(solution.problem, t, x)


def _lanes(solution: NeuralSolution, name: str, extrapolate: bool, t: Array, x: Array) -> jax.Array:
    """A lookup at times (k,) and states (k, n)."""
    lo, hi = (jnp.asarray(corner, x.dtype) for corner in (solution.lo, solution.hi))

    def one(t: Number, x: State) -> jax.Array:
        if name == "value_at":
            found = value_of(solution, t, x)
        else:
            found = jax.grad(value_of, 2)(solution, t, x)
            if name == "control_at":
                assert solution.problem is not None
                assert solution.rule is not None
                found = pointwise.minimiser(solution.problem, solution.rule, t, x, found)
        return found if extrapolate else jnp.where(jnp.all((x >= lo) & (x <= hi)), found, jnp.nan)

    return jax.vmap(one)(t, x)


_compiled = functools.partial(jax.jit, static_argnames=("name", "extrapolate"))(_lanes)


def _in_blocks(solution: NeuralSolution, name: str, extrapolate: bool, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The same in blocks of few different sizes, because each size is another program."""
    block = next((size for size in BLOCKS if size >= len(x)), BLOCKS[-1])
    parts = []
    for first in range(0, max(len(x), 1), block):
        rows = np.arange(first, min(first + block, len(x)))
        if not len(rows):
            raise ValueError(f"NeuralSolution.{name}: got no states")
        filled = np.resize(rows, block)
        parts.append(np.asarray(_compiled(solution, name, extrapolate, t[filled], x[filled]))[: len(rows)])
    return np.concatenate(parts)


def with_problem(solution: NeuralSolution, problem: Problem) -> NeuralSolution:
    """The solution with the problem of its controls, after checks."""
    n = solution.ndim
    with own_settings(x64=True):
        checks.of_one_state(problem, n, "the number of states of the file")
        problem = closures.settled(problem, n)
        rule = None if problem.controls is None else pointwise.rule_of(problem, n)
    return NeuralSolution(
        solution.ansatz, solution.lo, solution.hi, problem, rule, solution.code, solution.validation, solution.history,
        solution.seconds,
    )  # fmt: skip
