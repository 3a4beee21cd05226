"""Ready problems, most of them with an exact value to compare with.

A ready problem is a function that returns ``(problem, grid)``. The function of the same name with the suffix
``_exact`` takes the same keywords and returns the value as a function of one state. ``catalogue`` lists all problems
under the names that the command line uses.

    >>> from hjbjax import zoo
    >>> problem, grid = zoo.bang_bang(noise=0.5)
    >>> value = zoo.bang_bang_exact(noise=0.5)
    >>> problem.controls.dim, grid.shape, value([0.0]).shape
    (1, (81,), ())
"""

from typing import TYPE_CHECKING, NoReturn

from hjbjax.problem import words
from hjbjax.zoo.constrained_firm import ConstrainedFirm, Refinancing, liquidation, refinancing
from hjbjax.zoo.dividends import Reserve, dividends, dividends_exact
from hjbjax.zoo.entry import Entry
from hjbjax.zoo.finance import Merton, Wealth, merton, merton_exact, merton_wealth, merton_wealth_exact
from hjbjax.zoo.geometric import Angle, CarWithTrailers, OneWay, Pomet, Unicycle
from hjbjax.zoo.growth import Ramsey, growth, growth_exact
from hjbjax.zoo.landing import Lander, moon_landing, moon_landing_burn, moon_landing_exact
from hjbjax.zoo.linear_quadratic import (
    LinearScalar,
    double_integrator_lq,
    double_integrator_lq_exact,
    lq_game,
    lq_game_exact,
    stochastic_lq,
    stochastic_lq_exact,
)
from hjbjax.zoo.manipulator import Manipulator, manipulator
from hjbjax.zoo.manufactured import Smooth, smooth, smooth_exact
from hjbjax.zoo.mechanical import (
    BallAndBeam,
    FlexibleJoint,
    Pendulum,
    PlanarQuadrotor,
    VanDerPol,
    pendulum,
    pendulum_near_upright,
    van_der_pol,
)
from hjbjax.zoo.minimum_time import (
    Boat,
    DoubleIntegrator,
    double_integrator,
    double_integrator_exact,
    zermelo,
    zermelo_exact,
)
from hjbjax.zoo.pursuit import Adrift, Chase, adrift_exact, pursuit
from hjbjax.zoo.shortest_paths import Dubins, SingleIntegrator, dubins, eikonal, eikonal_exact
from hjbjax.zoo.stochastic import (
    BangBang,
    bang_bang,
    bang_bang_exact,
    brownian_ball,
    brownian_ball_exact,
    brownian_exit,
    brownian_exit_exact,
)
from hjbjax.zoo.stopping import (
    AmericanPut,
    Firm,
    american_put,
    leland,
    leland_exact,
    perpetual_put,
    perpetual_put_exact,
)
from hjbjax.zoo.switching import Saving, Thermostat, saving, thermostat
from hjbjax.zoo.transaction_costs import Portfolio, transaction_costs

_ENTRIES = (
    # slightly off the hanging position θ = π, where swinging up to the left and to the right cost the same
    Entry("pendulum", "swing a pendulum up and hold it upright", pendulum, start=(2.8, 0.0), duration=6.0),
    Entry(
        "double-integrator",
        "bring a mass to rest at the origin in the least time",
        double_integrator,
        double_integrator_exact,
        # from rest at 1 the least time is 2, half the duration of the picture
        start=(1.0, 0.0),
        duration=4.0,
        kinked=True,
    ),
    Entry(
        "double-integrator-lq",
        "bring a mass to rest at a quadratic cost",
        double_integrator_lq,
        double_integrator_lq_exact,
        start=(1.0, 0.0),
        duration=8.0,
    ),
    Entry(
        "manipulator", "raise a planar arm of n links and hold it upright", manipulator, start=(2.0, 0.0), duration=6.0
    ),
    Entry(
        "stochastic-lq",
        "hold a linear system near zero against noise",
        stochastic_lq,
        stochastic_lq_exact,
        start=(1.0,),
        duration=5.0,
    ),
    Entry("lq-game", "attenuate a disturbance to the level gamma", lq_game, lq_game_exact, start=(1.0,), duration=5.0),
    Entry(
        "brownian-exit",
        "how long a Brownian motion stays in a cube",
        brownian_exit,
        brownian_exit_exact,
        start=(0.0,),
        duration=4.0,
    ),
    Entry(
        "brownian-ball",
        "how long a Brownian motion stays in a ball",
        brownian_ball,
        brownian_ball_exact,
        start=(0.0, 0.0),
        duration=4.0,
    ),
    Entry(
        "zermelo",
        "steer a boat through a current in the least time",
        zermelo,
        zermelo_exact,
        # downstream of the origin, so the boat sails against the current
        start=(1.0, -1.0),
        duration=5.0,
    ),
    # the least time from this point is its norm, which is less than 1
    Entry("eikonal", "the shortest way to the origin", eikonal, eikonal_exact, start=(0.8, 0.5), duration=2.0),
    Entry(
        "dubins",
        "drive a car that cannot turn on the spot to a disc",
        dubins,
        # too close to turn towards the disc at once: the car turns away from it first
        start=(0.0, 1.2, 0.0),
        duration=8.0,
        kinked=True,
    ),
    # starts on the limit cycle, whose amplitude is 2
    Entry("van-der-pol", "quieten a Van der Pol oscillator", van_der_pol, start=(2.0, 0.0), duration=10.0),
    Entry("bang-bang", "hold a point near zero with a bounded speed", bang_bang, bang_bang_exact, start=(1.5,)),
    Entry(
        "merton",
        "consume and invest under constant relative risk aversion",
        merton,
        merton_exact,
        # wealth 1, whose logarithm is zero
        start=(0.0,),
        duration=10.0,
    ),
    Entry(
        "merton-wealth",
        "consume and invest, in levels of wealth instead of logarithms",
        merton_wealth,
        merton_wealth_exact,
        start=(1.0,),
        duration=10.0,
    ),
    Entry(
        "growth",
        "how much of the output to consume and how much to invest",
        growth,
        growth_exact,
        # a third of the steady state with the defaults
        start=(3.0,),
        duration=40.0,
    ),
    Entry(
        "perpetual-put",
        "when to exercise an American put without maturity",
        perpetual_put,
        perpetual_put_exact,
        start=(100.0,),
        duration=10.0,
    ),
    Entry(
        "american-put",
        "when to exercise an American put before it matures",
        american_put,
        # at the strike, one unit of time before maturity
        start=(40.0, 1.0),
        duration=1.0,
    ),
    Entry(
        "leland",
        "when the owners of a firm default on its debt",
        leland,
        leland_exact,
        # the logarithm of assets worth 80; from 100 the path leaves the box
        start=(4.38,),
        duration=10.0,
    ),
    Entry(
        "dividends",
        "when a firm pays out its cash, until ruin",
        dividends,
        dividends_exact,
        # above the barrier, so the path starts with a payment
        start=(1.0,),
        duration=10.0,
    ),
    Entry(
        "transaction-costs",
        "consume and invest where every trade costs a share of its size",
        transaction_costs,
        # almost all in bonds, so the path starts with a purchase
        start=(0.1,),
        duration=20.0,
    ),
    Entry(
        "liquidation",
        "investment and payout of a firm that is liquidated without cash",
        liquidation,
        # a third of the payout boundary
        start=(0.07,),
        duration=10.0,
    ),
    Entry(
        "refinancing",
        "investment, payout and equity issues of a firm",
        refinancing,
        # with little cash, so an issue is likely
        start=(0.03,),
        duration=10.0,
        mode="operating",
    ),
    Entry(
        "saving",
        "consume and save with two incomes that alternate at random",
        saving,
        start=(0.5,),
        duration=20.0,
        mode="poor",
    ),
    Entry(
        "thermostat",
        "hold a temperature with a heater whose switching costs something",
        thermostat,
        # colder than wanted, so the heater is switched on at once
        start=(17.0,),
        duration=10.0,
        mode="off",
    ),
    Entry(
        "pursuit",
        "catch a swimmer with a boat whose rudder breaks at random",
        pursuit,
        # the boat has turned towards the swimmer shortly before its rudder breaks, in the run that is drawn
        start=(2.0, 1.2),
        duration=4.0,
        mode="steers",
    ),
    Entry(
        "moon-landing",
        "land a rocket with the least fuel: when to start the engine",
        moon_landing,
        moon_landing_exact,
        # at rest at height 1 with full mass: a coast, then the burn
        start=(1.0, 0.0, 1.0),
        duration=2.0,
        finish=moon_landing_burn,  # the problem on the grid ends where the burn begins
    ),
    Entry("smooth", "a smooth nonlinear problem made for a known value", smooth, smooth_exact, start=(0.8, 0.5)),
)

# in the order that `hjbjax list` prints
catalogue: dict[str, Entry] = {entry.name: entry for entry in _ENTRIES}

__all__ = [
    "Adrift",
    "AmericanPut",
    "Angle",
    "BallAndBeam",
    "BangBang",
    "Boat",
    "CarWithTrailers",
    "Chase",
    "ConstrainedFirm",
    "DoubleIntegrator",
    "Dubins",
    "Entry",
    "Firm",
    "FlexibleJoint",
    "Lander",
    "LinearScalar",
    "Manipulator",
    "Merton",
    "OneWay",
    "Pendulum",
    "PlanarQuadrotor",
    "Pomet",
    "Portfolio",
    "Ramsey",
    "Refinancing",
    "Reserve",
    "Saving",
    "SingleIntegrator",
    "Smooth",
    "Thermostat",
    "Unicycle",
    "VanDerPol",
    "Wealth",
    "adrift_exact",
    "american_put",
    "bang_bang",
    "bang_bang_exact",
    "brownian_ball",
    "brownian_ball_exact",
    "brownian_exit",
    "brownian_exit_exact",
    "catalogue",
    "dividends",
    "dividends_exact",
    "double_integrator",
    "double_integrator_exact",
    "double_integrator_lq",
    "double_integrator_lq_exact",
    "dubins",
    "eikonal",
    "eikonal_exact",
    "growth",
    "growth_exact",
    "leland",
    "leland_exact",
    "liquidation",
    "lq_game",
    "lq_game_exact",
    "manipulator",
    "merton",
    "merton_exact",
    "merton_wealth",
    "merton_wealth_exact",
    "moon_landing",
    "moon_landing_burn",
    "moon_landing_exact",
    "pendulum",
    "pendulum_near_upright",
    "perpetual_put",
    "perpetual_put_exact",
    "pursuit",
    "refinancing",
    "saving",
    "smooth",
    "smooth_exact",
    "stochastic_lq",
    "stochastic_lq_exact",
    "thermostat",
    "transaction_costs",
    "van_der_pol",
    "zermelo",
    "zermelo_exact",
]

if not TYPE_CHECKING:  # otherwise type checkers would accept any name

    def __getattr__(name: str) -> NoReturn:
        """Refuse a name that does not exist, with the way out; Python calls this function for no other name."""
        raise AttributeError(words.missing(f"module {__name__!r}", name, words.OF_ZOO, __all__), name=name)
