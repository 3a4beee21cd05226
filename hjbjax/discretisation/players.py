"""The two players: their sets, and how the Hamiltonian depends on them, read from the problem's functions.

The optimum over a player's actions is exact if the drift is affine in them, the noise independent of them, and the cost
quadratic, over a box, a ball or a simplex of any dimension. Inputs that drive a common component, or whose product
enters the cost, form a group. The method depends on the group:

    one input of a box, or two without a product    all ends, kinks and stationary points are tried (``piecewise``)
    a ball, one component per input at most         all combinations of pieces are tried (``ball``)
    a simplex that drives no component              the multiplier of the sum (``simplex``)
    two inputs of a simplex                         as one input of a box, since the other is the rest of the total
    any other                                       convex quadratic programs (``quadratic_program``)

The last method requires a cost that is convex for a minimiser and concave for a maximiser. This depends on numbers that
are not known here, see ``exact.may_miss``. All three require that the components have few pieces together.

In a game whose players share a component, a cost or the noise, only the player who answers is exact. The player who
moves first faces a function with ridges, which is searched.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import remembered
from hjbjax.problem.sets import AdmissibleSet, Ball, Box, Finite, Simplex, is_unbounded
from hjbjax.tracing import dependence
from hjbjax.tracing.operations import Operations

SAMPLES = 33  # points of a continuous set before refinement
SHORT = 200  # largest number of operations on components for which evaluations of H are written out one after the other
# The weight of one evaluation of a longer function, or of one with a contraction, so that no two are written out in a
# row. At 300 operations a search in a loop compiles in half the time (6 s instead of 12.9 s), and similarly for two
# layers of 32; both run as fast as written out.
ALONE = 80
CELLS = {1: 64, 2: 16}  # inputs of a group: the largest number of combinations of pieces to try
QUADRATICS = 50  # in a ball: three inputs make 27 without noise, two make 49 with noise; beyond, programs are faster
PROGRAMS = 256  # choices of concave kinks, each a convex program: eight components without noise, four with noise


@dataclasses.dataclass(frozen=True)
class Player:
    """The actions of one player and their effect on the Hamiltonian; static, known from the jaxpr.

    Attributes:
      admissible: the admissible set, or None.
      sign: +1 minimises, −1 maximises.
      exact: True if the optimum is found exactly rather than by samples.
      driven: for every input the drift components that it drives.
      groups: the inputs, grouped by shared drift components and by products in the cost; H is a sum over the groups.
        All inputs of a simplex are one group, and all inputs of a ball if their optimum needs quadratic programs.
      cells: for every group the number of pieces that the Hamiltonian may have.
      programs: for every group, True if its optimum is found by quadratic programs.
      curved: for every input, True if the cost may contain its square.
      products: the pairs of inputs, the smaller index first, whose product the cost may contain.
      fastest_at_ends: True if the largest rate of leaving a node is attained at the ends of the set.
      effort: the weight of one evaluation of H when deciding what to write out.
      switches: True if the rates of jumps, including changes of the mode, depend on its inputs.
      lands: True if the states after jumps depend on its inputs.
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
    switches: bool = False
    lands: bool = False

    def derivative(self, problem: Problem, function: Callable, j: int) -> Callable:
        """∂/∂u_j of a function of the problem's arguments, as a function of one state without unneeded axes."""
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
        """True if all of the player's actions are tried, because the set is finite or absent."""
        return isinstance(self.admissible, (Finite, type(None)))

    @property
    def weight(self) -> int:
        """The approximate number of evaluations of H in one optimisation, each weighted by its effort."""
        if self.admissible is None:
            return self.effort
        if isinstance(self.admissible, Finite):
            return len(self.admissible.points) * self.effort
        if not self.exact:  # the pattern search between samples is a loop, which is compiled once
            return SAMPLES * self.effort
        if any(self.programs):  # nested loops, which are compiled once
            return SAMPLES * ALONE
        return self.effort * sum(
            3 + cells if len(group) == 1 else 10 * cells for group, cells in zip(self.groups, self.cells, strict=True)
        )

    @property
    def programmed(self) -> bool:
        """True if the optimum of an exact player is found by quadratic programs for some inputs."""
        return self.exact and any(self.programs)


@dataclasses.dataclass(frozen=True)
class Players:
    """Both players and their coupling.

    Attributes:
      control, disturbance: the players.
      decoupled: True if H is a sum over the two players on the grid too, because they drive different components or
        their drifts are upwinded separately; then the Isaacs condition holds on every grid.
      disturbance_costs: True if the running cost depends on the disturbance.
      steers_noise: True if the noise depends on an action.
      isaacs: the order of the moves, as in ``Problem``; the first player's optimum is searched unless decoupled.
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
        """True if min (max) over the sets is exact, which certificates require."""
        first, second = (self.control, self.disturbance) if self.isaacs == "upper" else (self.disturbance, self.control)
        if second.admissible is not None and not self.decoupled:  # the reply is not a polynomial in the first action
            return first.enumerated and (second.exact or second.enumerated)
        return all(player.exact or player.enumerated for player in self.both)


@remembered
def find_players(problem: Problem, n: int, dtype: Any) -> Players:
    """The players of a problem with ``n`` states, read from its functions."""
    found = dependence.influence(problem, n, dtype)
    branches = 2 if problem.noise is None else 4  # central differences have three kinks per component
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
    # an affine drift makes the rate of leaving a node convex
    affine = drift.affine_in(inputs) and found.switching.affine_in(inputs) and noise.free_of(inputs)
    # without bounds there are no ends, and the fastest action is known only once it has been chosen
    at_ends = (affine and not is_unbounded(admissible)) or isinstance(admissible, (Finite, type(None)))
    suits = affine and found.landing.free_of(inputs)
    suits &= cost.quadratic_in(inputs) and isinstance(admissible, (Box, Ball, Simplex))
    products = frozenset(tuple(j - inputs.start for j in pair) for pair in cost.products_in(inputs))
    groups = _groups(driven, products)
    if isinstance(admissible, Ball):
        apart = all(len(group) == 1 for group in groups) and all(len(components) <= 1 for components in driven)
        few = not any(curved) or combinations([branches ** len(each) for each in driven]) <= QUADRATICS
        together = not (apart and few and admissible.dim <= 3)
        groups = (tuple(range(len(driven))),) if together else groups
        programs = (together,) * len(groups)
    elif isinstance(admissible, Simplex):
        groups = (tuple(range(len(driven))),)
        pieces = branches ** len(shared(driven, groups[0]))
        programs = (admissible.freedom > 0 and pieces > (CELLS[1] if admissible.freedom == 1 else 1 - bool(products)),)
        if admissible.freedom == 0:  # the only action
            suits = at_ends = True
    else:
        joined = {j for pair in products for j in pair}
        programs = tuple(
            branches ** len(shared(driven, group)) > CELLS.get(len(group), 0) or bool(joined & set(group))
            for group in groups
        )
    cells = tuple(branches ** len(shared(driven, group)) for group in groups)
    suits &= all(count <= PROGRAMS for count, program in zip(cells, programs, strict=True) if program)
    return Player(
        admissible, sign, suits, driven, groups, cells, programs, curved, products, at_ends, _effort(found.operations),
        not found.switching.free_of(inputs), not found.landing.free_of(inputs),
    )  # fmt: skip


def _effort(needed: Operations) -> int:
    """1 for a short function; for a long one a weight that makes a search try its actions one by one in a loop."""
    return 1 if needed.whole == 0 and needed.single <= SHORT else ALONE


def _groups(driven: Sequence[tuple[int, ...]], products: frozenset[tuple[int, ...]]) -> tuple[tuple[int, ...], ...]:
    """The inputs in groups that share neither a component nor a product."""
    groups: list[list[int]] = []
    for j, components in enumerate(driven):
        partners = {k for pair in products if j in pair for k in pair}
        meets = [group for group in groups if set(shared(driven, group)) & set(components) or partners & set(group)]
        # an input that shares a component with two groups merges them, because their pieces depend on each other
        joined = [*(k for group in meets for k in group), j]
        groups = [group for group in groups if group not in meets] + [joined]
    return tuple(tuple(sorted(group)) for group in sorted(groups))


def combinations(pieces: Sequence[int]) -> int:
    """The number of combinations for inputs whose gains have the given numbers of pieces, with kinks between them."""
    return math.prod(2 * count - 1 for count in pieces)


def shared(driven: Sequence[tuple[int, ...]], group: Sequence[int]) -> tuple[int, ...]:
    """The components that a group of inputs drives."""
    return tuple(sorted({i for j in group for i in driven[j]}))
