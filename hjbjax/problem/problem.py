"""The control problem or differential game: one variational inequality, with every ingredient optional.

    min{ max{ β V − V_t − H(x, DV, D²V),  V − ψ },  V − g } = 0
    H = min_u max_d [ L(x,u,d) + f(x,u,d)·DV + ½ tr(σσᵀ(x,u,d) D²V) ]

The control minimises the cost, the disturbance maximises it. With rewards instead of costs the control maximises and
the disturbance minimises. All functions act on one state.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem import labels as labelling
from hjbjax.problem.jumps import Jump, check_jumps
from hjbjax.problem.labels import COST, REWARD, Labels
from hjbjax.problem.modes import Modes
from hjbjax.problem.pushes import Push, check_pushes
from hjbjax.problem.pytree import as_partial, is_traced, numbers, pytree_dataclass
from hjbjax.problem.sets import AdmissibleSet, AnyControl, Ball, Box, Finite, Simplex
from hjbjax.problem.spaces import is_environment, is_space
from hjbjax.problem.types import Control, Disturbance, Number, Numbers, State
from hjbjax.problem.words import shown

PAYMENTS = {  # the payments of a problem with rewards, and the same payments as costs
    "reward": "cost",
    "exit_reward": "exit_cost",
    "terminal_reward": "terminal_cost",
    "stopping_reward": "stopping_cost",
}
STATIC = (
    "isaacs", "time_dependent", "control_names", "control_units", "inside", "discounted", "payoff", "push_steps",
    "value_name", "time_unit",
)  # fmt: skip


@pytree_dataclass(static=STATIC)
class Problem:
    """An optimal control problem or a two-player zero-sum differential game.

    Functions act on one state. ``drift``, ``cost``, ``reward`` and a callable ``noise`` take ``(x, u)``; they take
    ``(x, u, d)`` if ``disturbances`` is given. ``target``, ``running_max`` and the payments ``exit_cost``,
    ``terminal_cost`` and ``stopping_cost``, or the rewards of the same names, take ``(x)``. With
    ``time_dependent=True`` the time comes first in all, and with ``modes`` the number of the mode comes last in all.
    Functions of ``jumps`` take the same arguments as ``drift``.

    The control minimises costs. Give ``reward`` and the other rewards instead to maximise: the value is then the
    largest reward, and the disturbance minimises it. Value, bounds, derivatives and pictures have the sign of the
    rewards. A problem has costs or rewards, not both.

    Args:
      drift: f, returns shape (n,): the rate of change of the state.
      cost: L, returns a scalar: cost per unit time. Default: zero.
      controls: the admissible set of u, shape (m,). ``None``: there is no control and u has shape (0,). A function of
        the state that returns a ``Box`` bounds the controls by the state: ``lambda x: Box(lo(x), hi(x))``.

    Keyword Args:
      disturbances: the admissible set of the opponent's d.
      noise: σ in dx = f dt + σ dw: a scalar ε (σ = ε I), an (n,) diagonal, an (n, k) matrix, or a function
        with the arguments of ``drift`` that returns one of these.
      discount: β ≥ 0, per unit time; or a function of the state, such as a mortality or a short rate. Then a path is
        discounted by exp(−∫ β(x) dt). Without a horizon it must be positive everywhere; ``march`` takes any sign, and
        functions of (t, x) if ``time_dependent``.
      growth: g, the rate at which the scale of all payments grows, with the arguments of ``drift``. If the value is
        proportional to a state K with dK = g K dt, such as the capital of a firm, leave K out of x: the value per unit
        of K has the discount β − g. A hazard rate that depends on the control is a negative growth. Without a
        horizon β − g must be positive for all admissible controls. The minimum over u stays exact if g is affine in u.
        Default: zero.
      target: a function that is ≤ 0 inside the target, where paths end.
      exit_cost: the cost paid on the target; a number or a function. Default: zero.
      terminal_cost: V at the horizon, for ``march``.
      stopping_cost: ψ, which the controller may pay to stop: V ≤ ψ. With a discount or a terminal cost, infinity
        forbids stopping at a state.
      running_max: g, the cost is the running maximum of g: V ≥ g. Requires zero running cost and no discount.
      reward: the reward per unit time, maximised; utility, profit or income. Excludes all costs.
      exit_reward: the reward received on the target; a number or a function. Default: zero.
      terminal_reward: V at the horizon, for ``march``: scrap value, bequest or payoff.
      stopping_reward: the reward for stopping, at any time: V ≥ the reward, as for an American option.
      modes: the regimes between which the system changes at random or by choice, see ``Modes``. Values then have the
        shape (k, *grid).
      jumps: sudden moves of the state at random times, see ``Jump``.
      pushes: directions in which the controller may move the state at once, at a cost or a reward per unit of length,
        see ``Push``. The costs and rewards of jumps and pushes keep their meaning in a problem of either kind. A
        problem that has only these rewards is a problem with rewards.
      isaacs: ``"upper"`` is min over u of max over d (the disturbance sees u), ``"lower"`` is max min. With rewards
        the disturbance also sees u if ``"upper"``: max over u of min over d.
      time_dependent: True if the functions take the time as their first argument.
      control_names, control_units: one text per control, for plots, as in ("torque",) and ("N m",).
      inside: the side of the zero level that is the set of interest, for plots: ``"below"`` for {V ≤ 0}, ``"above"``
        for {V ≥ 0}, as in ``avoid``.
      value_name: V for plots, if it is not the cost itself, as in "V = 1 − e⁻ᵀ". Default: V.
      time_unit: the unit of time for plots, as in "s". Default: from the units of states and controls, such as m/s.

    Raises:
      ValueError: an ingredient that contradicts another, or a number that is not admissible.
      TypeError: an argument that must be a function and is not callable.

    Example:
      >>> import jax.numpy as jnp
      >>> Problem(lambda x, u: u, lambda x, u: x @ x + u @ u, Box([-1.0], [1.0]), discount=1.0).controls.dim
      1
      >>> Problem(  # wealth earns 3 %; the utility of consumption is maximised
      ...     lambda x, u: 0.03 * x - u, controls=Box([0.01], [2.0]), reward=lambda x, u: jnp.log(u[0]), discount=0.05
      ... ).payoff
      'reward'
    """

    drift: jax.tree_util.Partial
    cost: Any = None
    controls: Any = None
    disturbances: AdmissibleSet | None = None
    noise: Any = None
    discount: Any = 0.0
    growth: Any = None
    target: Any = None
    exit_cost: Any = None
    terminal_cost: Any = None
    stopping_cost: Any = None
    running_max: Any = None
    modes: Modes | None = None
    jumps: tuple[Jump, ...] = ()
    pushes: tuple[Push, ...] = ()
    isaacs: str = "upper"
    time_dependent: bool = False
    control_names: tuple[str, ...] = ()
    control_units: tuple[str, ...] = ()
    inside: str = "below"
    reward: Any = None
    exit_reward: Any = None
    terminal_reward: Any = None
    stopping_reward: Any = None
    value_name: str = ""
    time_unit: str = ""
    discounted: bool | None = dataclasses.field(init=False, default=None, repr=False)
    payoff: str = dataclasses.field(init=False, default=COST, repr=False)
    # the part of the discount that is a function of the state, in the problem of a march; the other part is constant
    killing: Any = dataclasses.field(init=False, default=None, repr=False)
    # the changes of the mode if the state begins with it, see ``mode_axis``: rates, and costs for the controller
    mode_rates: Any = dataclasses.field(init=False, default=None, repr=False)
    switching_costs: Any = dataclasses.field(init=False, default=None, repr=False)
    # the jumps as functions, see ``jump_terms``
    intensities: Any = dataclasses.field(init=False, default=None, repr=False)
    landings: Any = dataclasses.field(init=False, default=None, repr=False)
    jump_costs: Any = dataclasses.field(init=False, default=None, repr=False)
    # the pushes as one function of the state, see ``mode_axis``, and the axis and the sign of each
    push_costs: Any = dataclasses.field(init=False, default=None, repr=False)
    push_steps: tuple[tuple[int, int], ...] = dataclasses.field(init=False, default=(), repr=False)

    def __init__(
        self,
        drift: Callable,
        cost: Callable | None = None,
        controls: AdmissibleSet | Callable | None = None,
        *,
        disturbances: AdmissibleSet | None = None,
        noise: Callable | Numbers | Sequence | None = None,
        discount: Callable | Number = 0.0,
        growth: Callable | None = None,
        target: Callable | None = None,
        exit_cost: Callable | Number | None = None,
        terminal_cost: Callable | Number | None = None,
        stopping_cost: Callable | Number | None = None,
        running_max: Callable | None = None,
        modes: Modes | None = None,
        jumps: Sequence[Jump] = (),
        pushes: Sequence[Push] = (),
        isaacs: str = "upper",
        time_dependent: bool = False,
        control_names: Sequence[str] = (),
        control_units: Sequence[str] = (),
        inside: str = "below",
        reward: Callable | None = None,
        exit_reward: Callable | Number | None = None,
        terminal_reward: Callable | Number | None = None,
        stopping_reward: Callable | Number | None = None,
        value_name: str = "",
        time_unit: str = "",
    ):
        _check_functions(drift, target)
        _check_sets(controls, disturbances)
        # unknown for a function of the state
        count = None if callable(controls) else 0 if controls is None else controls.dim
        words = labelling.checked(control_names, control_units, inside, count, value_name, time_unit)
        # static: the order of min and max is part of a compiled program
        if isaacs not in ("upper", "lower"):
            raise ValueError(f"Problem.isaacs: got {isaacs!r}, wanted 'upper' (min max) or 'lower' (max min)")
        discount = _rate(discount)
        if not isinstance(time_dependent, (bool, np.bool_)):
            raise TypeError(f"Problem.time_dependent: got {time_dependent!r}, wanted True or False")
        if modes is not None and not isinstance(modes, Modes):
            raise TypeError(f"Problem.modes: got {modes!r}, wanted hjb.Modes(('low', 'high'), rates=...)")
        jumps, pushes = check_jumps(jumps), check_pushes(pushes)
        # with a running maximum, V ≥ g, there is no integral to discount, so β V − L has no meaning
        if running_max is not None and (cost is not None or pushes or growth or _is_nonzero(discount)):
            raise ValueError(
                "Problem.running_max: the cost is only the running maximum; "
                "leave out cost, pushes and discount, also growth, or put the running cost into a stopping_cost"
            )
        costs = {
            "cost": cost, "exit_cost": exit_cost, "terminal_cost": terminal_cost, "stopping_cost": stopping_cost,
        }  # fmt: skip
        rewards = {
            "reward": reward, "exit_reward": exit_reward, "terminal_reward": terminal_reward,
            "stopping_reward": stopping_reward,
        }  # fmt: skip
        payoff = _payoff(costs | {"running_max": running_max}, rewards, (*jumps, *pushes))
        for name, paid in {"exit_cost": exit_cost, "exit_reward": exit_reward}.items():
            if paid is not None and target is None:
                raise ValueError(f"Problem.{name}: there is no target to pay it on; give target as well")
        # every function becomes a pytree, so that numbers in it are leaves of the problem
        fields = {
            "drift": as_partial(drift, "Problem.drift"),
            **{name: _payment(paid, f"Problem.{name}") for name, paid in (costs | rewards).items()},
            "controls": as_partial(controls, "Problem.controls") if callable(controls) else controls,
            "disturbances": disturbances,
            "noise": _noise(noise),
            "discount": discount,
            "growth": as_partial(growth, "Problem.growth"),
            "target": as_partial(target, "Problem.target"),
            "running_max": as_partial(running_max, "Problem.running_max"),
            "modes": modes,
            "jumps": jumps,
            "pushes": pushes,
            "isaacs": isaacs,
            "time_dependent": bool(time_dependent),
            "control_names": words.controls,
            "control_units": words.control_units,
            "inside": words.inside,
            "value_name": words.value,
            "time_unit": words.time_unit,
            # static, because ``jit`` hides numbers and the certificate must be chosen while compiling
            "discounted": growth is not None or known_sign(discount),
            "payoff": payoff,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def labels(self) -> Labels:
        """The words for plots and messages: names and units, side of the level set, cost or reward."""
        return Labels(self.control_names, self.control_units, self.inside, self.payoff, self.value_name, self.time_unit)

    @property
    def is_game(self) -> bool:
        """True if there is an opponent."""
        return self.disturbances is not None

    def arguments(self, x: object, u: object, d: object = None, t: object = 0.0) -> tuple:
        """The arguments of ``drift``, ``cost`` and ``noise`` in order: arrays, lists of entries, or names."""
        return (t,) * self.time_dependent + (x, u) + (d,) * self.is_game

    def state_arguments(self, x: object, t: object = 0.0) -> tuple:
        """The arguments that ``target`` and the other functions of the state take, in order."""
        return (t,) * self.time_dependent + (x,)

    def diffusion(self, x: State, u: Control, d: Disturbance | None = None, t: Number = 0.0) -> jax.Array:
        """σ at one state as a matrix, shape (n, k); (n, 0) without noise."""
        n = jnp.shape(x)[-1]
        if self.noise is None:
            return jnp.zeros((n, 0))
        sigma = jnp.asarray(self.noise(*self.arguments(x, u, d, t)) if callable(self.noise) else self.noise)
        if sigma.ndim == 0:  # independent noise of strength ε on every state
            return sigma * jnp.eye(n, dtype=sigma.dtype)
        return jnp.diag(sigma) if sigma.ndim == 1 else sigma


def is_discounted(problem: Problem) -> bool | None:
    """True if the discount is positive; None if this is known only when the compiled program runs.

    A problem stores it in its structure, so it is known inside ``jit`` even if the number is traced.
    """
    if callable(problem.discount) or problem.growth is not None:  # checked at the nodes
        return True
    if is_traced(problem.discount):
        return problem.discounted
    return bool(np.all(np.asarray(problem.discount) > 0))  # a batch has one discount per problem: all must be positive


def check_constant_discount(problem: Problem, caller: str) -> None:
    """Refuse a discount or a growth that depends on the state; ``caller`` is the function that the user called."""
    if callable(problem.discount):
        got, rate = "a discount that is a function of the state, wanted a number", "discount"
    elif problem.growth is not None:
        got, rate = "a problem with growth, wanted one without", "(discount - growth)"
    else:
        return
    raise ValueError(
        f"{caller}: got {got}; make ∫ {rate} dt a state z with z(0) = 0, and multiply the costs by exp(−z)"
    )


def known_sign(discount: Callable | Number) -> bool | None:
    """True if a discount is positive, also for a function; None for a traced number."""
    return callable(discount) or (None if is_traced(discount) else bool(discount > 0))


def is_random(problem: Problem) -> bool:
    """True if paths of the problem are random: noise, jumps, or random changes of the mode."""
    return problem.noise is not None or changes_at_random(problem)


def changes_at_random(problem: Problem) -> bool:
    """True if the state jumps or the mode changes at random times."""
    jumps = bool(problem.jumps) or problem.intensities is not None
    return jumps or problem.mode_rates is not None or (problem.modes is not None and problem.modes.rates is not None)


def is_constrained(problem: Problem) -> bool:
    """True if the problem has a stopping cost or a running maximum."""
    return problem.stopping_cost is not None or problem.running_max is not None


def has_interventions(problem: Problem) -> bool:
    """True if the controller may change the mode or push the state, and pays for each change or push."""
    changes = problem.switching_costs is not None
    changes |= problem.modes is not None and problem.modes.switching_cost is not None
    return changes or bool(problem.pushes) or bool(problem.push_steps)


def _payoff(costs: dict[str, Any], rewards: dict[str, Any], moves: Sequence[Jump | Push]) -> str:
    """The word for the payments of a problem, "cost" or "reward"; refuses both together, except in jumps and pushes."""
    paid, earned = ([name for name, given in each.items() if given is not None] for each in (costs, rewards))
    if not paid and not earned and any(move.reward is not None for move in moves):
        return REWARD
    if not earned:
        return COST
    if not paid:
        return REWARD
    cure = "leave out running_max" if paid == ["running_max"] else f"write {paid[0]} as a reward, minus the cost"
    raise ValueError(
        f"Problem: got {' and '.join(paid)} together with {' and '.join(earned)}; wanted only costs or only rewards.\n"
        f"The control minimises a cost and maximises a reward. To maximise, {cure};\n"
        "to minimise, write the rewards as costs, minus the reward."
    )


def _payment(paid: Any, name: str) -> Any:
    """A running payment as a function, any other payment as a function or a number."""
    return as_partial(paid, name) if name in ("Problem.cost", "Problem.reward") else _function_or_number(paid, name)


def _is_nonzero(discount: Callable | Number) -> bool:
    """True if there is a discount; a traced one and a function count as nonzero."""
    return callable(discount) or is_traced(discount) or bool(discount != 0)


def _check_functions(drift: object, target: object) -> None:
    """Refuse a drift or a target that is not a function, with the function that was probably meant."""
    if is_environment(drift):
        raise TypeError(
            "Problem.drift: got an environment, wanted a function (x, u) -> (n,): write the step of the environment as "
            "a rate of change,\nand controls=hjb.from_gymnasium(env.action_space)"
        )
    if not callable(drift):
        raise TypeError(f"Problem.drift: got {shown(drift)}, wanted a function (x, u) -> (n,)")
    if isinstance(target, (tuple, list, np.ndarray)):
        cure = "the union of several targets is lambda x: jnp.minimum(first(x), second(x))"
        if not any(map(callable, target)):
            cure = "a ball around a point is lambda x: jnp.linalg.norm(x - point) - radius"
        raise TypeError(f"Problem.target: got {target!r:.100}, wanted a function of the state, ≤ 0 inside;\n{cure}")


def _check_sets(controls: object, disturbances: object) -> None:
    """Refuse sets of an unknown kind; a common mistake is to pass bounds without a ``Box``."""
    for name, admissible in (("controls", controls), ("disturbances", disturbances)):
        if name == "controls" and callable(admissible):  # bounds that depend on the state
            continue
        if admissible is not None and not isinstance(admissible, (Box, Ball, Simplex, Finite, AnyControl)):
            raise TypeError(
                f"Problem.{name}: got {admissible!r:.200}, wanted a Box, a Ball, a Simplex, a Finite or None"
                f"{_set_for(admissible)}"
            )


def _set_for(given: object) -> str:
    """The set that was probably meant, for a message."""
    if is_space(given):
        return " of hjbjax: hjb.from_gymnasium(space)"
    try:
        count, numeric = np.ndim(given), np.asarray(given).dtype.kind in "iuf"  # type: ignore[arg-type]
    except ValueError:
        return ""
    if isinstance(given, (tuple, list)) and len(given) == 2:
        return f": hjb.Box({given[0]!r}, {given[1]!r})"
    if numeric and count == 1:
        return ": the values of one input are hjb.Finite(values[:, None]), all values between them hjb.Box(lo, hi)"
    return ": hjb.Finite(points)" if numeric and count == 2 else ""


def _rate(discount: object) -> Any:
    """The discount as a float, as a tracer, or as a function."""
    if callable(discount):
        return as_partial(discount, "Problem.discount")
    rate = numbers(discount, "Problem.discount")
    if np.ndim(rate) != 0 or (isinstance(rate, np.ndarray) and not 0 <= rate < np.inf):
        raise ValueError(
            f"Problem.discount: got {shown(discount)}, wanted a finite number ≥ 0, or a function of the state"
        )
    return float(rate) if isinstance(rate, np.ndarray) else rate


def _noise(noise: object) -> Any:
    """σ as a function, a number or an array; its shape and its numbers are checked if they are known."""
    sigma = _function_or_number(noise, "Problem.noise", largest=2)  # ε, (n,) or (n, k)
    if sigma is None or callable(sigma) or is_traced(sigma):
        return sigma
    if not np.all(np.isfinite(sigma)):
        raise ValueError(f"Problem.noise: got {shown(noise)}, wanted finite numbers")
    # entries of a matrix may be negative: their signs set the correlation of the noises
    if np.ndim(sigma) < 2 and np.any(np.asarray(sigma) < 0):
        raise ValueError(f"Problem.noise: got {shown(noise)}, wanted numbers ≥ 0: it is σ in dx = f dt + σ dw")
    return sigma


def _function_or_number(value: object, name: str, largest: int = 0) -> Any:
    """A function as a pytree, or numbers in an array of at most ``largest`` dimensions."""
    if value is None or callable(value):
        return as_partial(value, name)
    array = numbers(value, name)
    if np.ndim(array) > largest:
        wanted = "a number, (n,) or (n, k)" if largest else "one number"
        raise ValueError(f"{name}: got shape {np.shape(array)}, wanted {wanted}")
    if not isinstance(array, np.ndarray):
        return array
    if np.any(np.isnan(array)):  # infinity is allowed: "never stop here", "never enter"
        raise ValueError(f"{name}: got {shown(value)}, which is not a number")
    return array if array.ndim else float(array)
