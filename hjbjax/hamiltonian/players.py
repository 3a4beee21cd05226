"""The two players: their sets, and how the Hamiltonian depends on them, read from the problem's functions.

The optimum over a player's actions is exact where the drift is affine in them, the noise free of them, and the cost
quadratic, over a box or a ball of any dimension. Inputs that drive a common component, or whose product enters the
cost, form a group. The method depends on the group:

    one input of a box, or two without a product    all ends, kinks and stationary points are tried (``piecewise``)
    a ball, one component per input at most         all combinations of pieces are tried (``ball``)
    any other                                       convex quadratic programs (``quadratic_program``)

The last one requires a cost that is convex for a minimiser and concave for a maximiser. That depends on numbers, which
are not known here: see ``exact.may_miss``. All three require that the components have few pieces together.

In a game whose players meet in a component, in a cost or in the noise, only the player who answers is exact. The player
who moves first faces a function with ridges, which is searched.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.discretisation.discretisation import Discretisation
from hjbjax.hamiltonian.ball import combinations
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite
from hjbjax.tracing import dependence
from hjbjax.tracing.operations import Operations

SAMPLES = 33  # points of a continuum before refinement
SHORT = 200  # operations on components up to which evaluations of H are written out one after the other
# What one evaluation of a longer function counts for, or of one with a contraction: no two are written out in a row. At
# 300 operations a search that is a loop compiles in half the time (6 s for 12.9), at two layers of 32 likewise; both
# run as fast as written out.
ALONE = 80
CELLS = {1: 64, 2: 16}  # by the inputs of a group: combinations of pieces that are tried at most
QUADRATICS = 50  # in a ball: three inputs without noise make 27, two with noise 49; programs are faster beyond
PROGRAMS = 256  # choices of concave kinks, each a convex program: eight components without noise, four with noise


@dataclasses.dataclass(frozen=True)
class Player:
    """What one player may do and how the Hamiltonian depends on it; static, known from the jaxpr.

    Attributes:
      admissible: the admissible set, or None.
      sign: +1 minimises, −1 maximises.
      exact: whether the optimum is found exactly rather than by samples.
      driven: for every input the drift components that it drives.
      groups: the inputs by what they drive together and by products in the cost; H is a sum over the groups. All inputs
        of a ball are one group where they are a program.
      cells: for every group in how many pieces the Hamiltonian may fall.
      programs: for every group whether its optimum is that of quadratic programs.
      curved: for every input whether the cost may hold its square.
      products: the pairs of inputs, the lesser first, whose product the cost may hold.
      fastest_at_ends: whether no action moves the chain faster than all those at the ends of the set do.
      effort: how many evaluations of H one counts for where they would be written out.
    """

    admissible: AdmissibleSet | None
    sign: int
    exact: bool
    driven: tuple[tuple[int, ...], ...]
    groups: tuple[tuple[int, ...], ...]
    cells: tuple[int, ...]
    programs: tuple[bool, ...]
    curved: tuple[bool, ...]
    products: frozenset[tuple[int, ...]]
    fastest_at_ends: bool
    effort: int

    def derivative(self, problem: Problem, function: Callable, j: int) -> Callable:
        """∂/∂u_j of a function of the problem's arguments, itself one of one state: it varies only as it must."""
        position = problem.time_dependent + (1 if self.sign > 0 else 2)

        def along(*arguments: Any) -> Any:
            action = jnp.asarray(arguments[position])
            unit = np.asarray(np.arange(action.size) == j, action.dtype)

            def moved(s: Any) -> Any:
                result = function(*arguments[:position], action + s * unit, *arguments[position + 1 :])
                return jnp.asarray(result, action.dtype)

            return jax.jvp(moved, (jnp.zeros((), action.dtype),), (jnp.ones((), action.dtype),))[1]

        return along

    @property
    def enumerated(self) -> bool:
        """Whether all of the player's actions are tried, since they are finitely many or there are none."""
        return isinstance(self.admissible, (Finite, type(None)))

    @property
    def weight(self) -> int:
        """About how many evaluations of H one optimisation takes, each counted by its effort."""
        if self.admissible is None:
            return self.effort
        if isinstance(self.admissible, Finite):
            return len(self.admissible.points) * self.effort
        if not self.exact:  # the pattern search between samples is a loop, which is compiled once
            return SAMPLES * self.effort
        if any(self.programs):  # a loop in loops, which is compiled once
            return SAMPLES * ALONE
        return self.effort * sum(
            3 + cells if len(group) == 1 else 10 * cells for group, cells in zip(self.groups, self.cells, strict=True)
        )

    @property
    def programmed(self) -> bool:
        """True if the optimum of an exact player is that of quadratic programs, for some inputs."""
        return self.exact and any(self.programs)


@dataclasses.dataclass(frozen=True)
class Players:
    """Both players and how they meet.

    Attributes:
      control, disturbance: the players.
      decoupled: whether H is a sum of what each player does on the grid, too: they drive different components, or each
        one's drift is upwinded by itself; then the Isaacs condition holds on every grid.
      disturbance_costs: whether the running cost depends on the disturbance.
      steers_noise: whether the noise depends on an action.
      isaacs: who moves first, as in ``Problem``; that player's optimum is searched unless the two are decoupled.
    """

    control: Player
    disturbance: Player
    decoupled: bool
    disturbance_costs: bool
    steers_noise: bool
    isaacs: str

    @property
    def both(self) -> tuple[Player, Player]:
        """The control and the disturbance."""
        return self.control, self.disturbance

    @property
    def exact(self) -> bool:
        """Whether min (max) over the sets is exact, which certificates need."""
        first, second = (self.control, self.disturbance) if self.isaacs == "upper" else (self.disturbance, self.control)
        if second.admissible is not None and not self.decoupled:  # the reply is no polynomial of what it replies to
            return first.enumerated and (second.exact or second.enumerated)
        return all(player.exact or player.enumerated for player in self.both)


def players_of(on: Discretisation) -> Players:
    """The players of a problem on its grid; those whose drifts are upwinded apart do not meet there."""
    players = find_players(on.problem, on.grid.ndim, on.dtype)
    return dataclasses.replace(players, decoupled=players.decoupled or on.apart)


def find_players(problem: Problem, n: int, dtype: Any) -> Players:
    """The players of a problem with ``n`` states, read from its functions."""
    found = dependence.influence(problem, n, dtype)
    branches = 2 if problem.noise is None else 4  # central differences have three kinks a component
    return Players(
        _player(problem.controls, 1, found, branches), _player(problem.disturbances, -1, found, branches),
        found.separable and not found.meet, not found.cost.free_of(found.disturbance),
        not found.noise.is_constant, problem.isaacs,
    )  # fmt: skip


def _player(admissible: AdmissibleSet | None, sign: int, found: dependence.Influence, branches: int) -> Player:
    """The control, for ``sign`` 1, or the disturbance, −1; drifts have ``branches`` pieces per component."""
    drift, cost, noise = found.drift, found.cost, found.noise
    inputs = found.control if sign > 0 else found.disturbance
    driven = tuple(drift.driven_by([j]) for j in inputs)
    curved = tuple(cost.has_square([j]) for j in inputs)
    affine = drift.affine_in(inputs) and noise.free_of(inputs)  # then the rate of leaving a node is convex
    at_ends = affine or isinstance(admissible, (Finite, type(None)))
    suits = affine and cost.quadratic_in(inputs) and isinstance(admissible, (Box, Ball))
    products = frozenset(tuple(j - inputs.start for j in pair) for pair in cost.products_in(inputs))
    groups = _groups(driven, products)
    if isinstance(admissible, Ball):
        apart = all(len(group) == 1 for group in groups) and all(len(components) <= 1 for components in driven)
        few = not any(curved) or combinations([branches ** len(each) for each in driven]) <= QUADRATICS
        together = not (apart and few and admissible.dim <= 3)
        groups = (tuple(range(len(driven))),) if together else groups
        programs = (together,) * len(groups)
    else:
        joined = {j for pair in products for j in pair}
        programs = tuple(
            branches ** len(shared(driven, group)) > CELLS.get(len(group), 0) or bool(joined & set(group))
            for group in groups
        )
    cells = tuple(branches ** len(shared(driven, group)) for group in groups)
    suits &= all(count <= PROGRAMS for count, program in zip(cells, programs, strict=True) if program)
    return Player(
        admissible, sign, suits, driven, groups, cells, programs, curved, products, at_ends, _effort(found.operations)
    )


def _effort(needed: Operations) -> int:
    """One for a short function; for a long one so much that a search tries its actions one by one in a loop."""
    return 1 if needed.whole == 0 and needed.single <= SHORT else ALONE


def _groups(driven: Sequence[tuple[int, ...]], products: frozenset[tuple[int, ...]]) -> tuple[tuple[int, ...], ...]:
    """The inputs in groups that have no component and no product in common."""
    groups: list[list[int]] = []
    for j, components in enumerate(driven):
        partners = {k for pair in products if j in pair for k in pair}
        meets = [group for group in groups if set(shared(driven, group)) & set(components) or partners & set(group)]
        # an input that drives what two groups drive makes them one: their pieces depend on one another
        joined = [*(k for group in meets for k in group), j]
        groups = [group for group in groups if group not in meets] + [joined]
    return tuple(tuple(sorted(group)) for group in sorted(groups))


def shared(driven: Sequence[tuple[int, ...]], group: Sequence[int]) -> tuple[int, ...]:
    """The components that a group of inputs drives."""
    return tuple(sorted({i for j in group for i in driven[j]}))
