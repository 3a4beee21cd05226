"""Words of other packages and books: the names used here, or how to write what they mean.

A keyword that a function does not have is refused with the name used here, and with an example if it means something
else here. So is a name that the package or one of its objects does not have.
"""

import difflib
from collections.abc import Iterable, Set
from typing import NamedTuple

SHOWN = 80  # characters of a refused value to quote

ELSEWHERE = {  # names of arguments in other packages and books, and the names used here
    **dict.fromkeys(("dynamics", "f", "ode", "fun"), ("drift",)),
    **dict.fromkeys(("loss", "l", "lagrangian"), ("cost",)),
    **dict.fromkeys(("utility", "profit", "payoff", "flow_payoff", "income", "return_function"), ("reward",)),
    **dict.fromkeys(("bequest", "scrap_value", "terminal_value", "terminal_utility"), ("terminal_reward",)),
    **dict.fromkeys(("exercise", "stopping_payoff", "stopping_value"), ("stopping_reward",)),
    **dict.fromkeys(("gamma", "beta", "rho", "rate", "mortality", "hazard", "short_rate"), ("discount",)),
    **dict.fromkeys(("u", "action", "actions", "input", "inputs", "u_space"), ("controls",)),
    **dict.fromkeys(("d", "adversary", "opponent"), ("disturbances",)),
    **dict.fromkeys(("sigma", "diffusion"), ("noise",)),
    "epsilon": ("noise", "tol"),
    **dict.fromkeys(("tolerance", "eps", "atol", "threshold", "xtol", "ftol"), ("tol",)),
    **dict.fromkeys(("verbose", "disp", "display", "callback"), ("progress",)),
    **dict.fromkeys(("seed", "rng", "random_state", "random_seed"), ("key",)),
    **dict.fromkeys(("controller", "policy", "agent"), ("feedback", "solution")),
    **dict.fromkeys(("initial", "init", "v0", "initial_values"), ("guess",)),
    **dict.fromkeys(("t", "tf", "t_final", "t_span", "time"), ("horizon", "duration")),
    **dict.fromkeys(("min", "lower", "left"), ("lo",)),
    **dict.fromkeys(("max", "upper", "right"), ("hi",)),
    **dict.fromkeys(("n", "num", "size", "points", "nodes", "resolution"), ("shape", "points")),
    **dict.fromkeys(("dt", "time_step"), ("step", "max_step")),
    **dict.fromkeys(("save_at", "saveat", "ts", "t_eval"), ("times",)),
    **dict.fromkeys(("noise", "r"), ("measurement_noise", "radius")),
    **dict.fromkeys(("goal",), ("target",)),
    **dict.fromkeys(("slice", "cut", "at"), ("fixed",)),
    **dict.fromkeys(("accuracy", "order", "discretization"), ("scheme",)),
    **dict.fromkeys(("solver", "algorithm"), ("method",)),
}


class Way(NamedTuple):
    """The advice for some words, in lower case, as keywords of functions that also have the keyword ``own``.

    Without ``own`` the advice is for any function that does not have another word for it.
    """

    words: tuple[str, ...]
    own: str | None
    advice: str


RATE = "discount is a rate per unit time; a factor gamma per step of length dt is discount=hjb.discount_rate(gamma, dt)"
MAXIMISE = "to maximise, write reward= instead of cost="
BOUNDS = "wanted controls=hjb.Box(lo, hi)"
ROLES = (
    "the control minimises and the disturbance maximises: hjb.reach is control_mode='min', disturbance_mode='max',\n"
    "hjb.avoid is 'max', 'min' with the opposite sign of V; to maximise a payoff, write reward= instead of cost="
)
LINEAR = "write matrices as functions: drift=lambda x, u: A @ x + B @ u, cost=lambda x, u: x @ Q @ x + u @ R @ u"
BOX = "the range of the states belongs to the grid: hjb.solve(problem, hjb.Grid(lo, hi, shape))"
LIMITS = (
    "the ends of the box are limits with hjb.Grid(..., edges='constrained'); another forbidden set is a target with a\n"
    "large exit_cost; bounds of controls may depend on the state: controls=lambda x: hjb.Box(lo(x), hi(x))"
)
OBSTACLE = (
    "an obstacle is a target with a large exit_cost, such as 1e3; for a target and an obstacle join both by\n"
    "jnp.minimum and make exit_cost a function. Reachable sets: hjb.reach_avoid(drift, controls, target, obstacle)"
)
TUBE = "a target and an obstacle are hjb.reach_avoid(drift, controls, target, obstacle), an obstacle only hjb.avoid"
HORIZON = "a finite horizon belongs to hjb.march(problem, grid, horizon), with Problem(terminal_cost=...)"
START = "V is computed for all states; follow a path with hjb.simulate(problem, solution, x0, duration)"
NODES = "wanted the number of nodes per axis, shape=(41, 41); the ends of the box are nodes"
STEP = "time is continuous: write the rate of change; hjb.simulate(..., hold=dt) holds the control for a step"
HOLD = "hold=dt holds the control for steps of this length; max_step= limits the steps of the integrator"
ENDS = "wanted edges=: 'projected', 'constrained', 'open', 'linear', hjb.Dirichlet(value), hjb.Neumann(slope)"
TABLES = "wanted drift=, the rate of change of the state; hjb.chain.transition_arrays exports the probabilities"
PICTURE = "the function returns a picture, which has .save(path), .ax and .figure"
CANVAS = "draw on axes of your own figure, ax=plt.subplots(figsize=(6, 4))[1], or change .ax and .figure of the picture"
PART = "belongs to the problem: hjb.Problem(drift, cost, controls, ...)"

WAYS = (
    Way(("gamma", "beta", "discount_factor"), "discount", RATE),
    Way(("maximize", "maximise", "minimize", "minimise", "sense"), "reward", MAXIMISE),
    Way(("action_space",), "controls", "wanted controls=hjb.from_gymnasium(env.action_space)"),
    Way(("u_min", "u_max", "umin", "umax", "bounds", "control_bounds", "control_space"), "controls", BOUNDS),
    Way(("d_min", "d_max", "disturbance_space"), "disturbances", "wanted disturbances=hjb.Box(lo, hi)"),
    Way(("control_mode", "disturbance_mode", "umode", "dmode", "u_mode", "d_mode"), "drift", ROLES),
    Way(("a", "b", "q", "r"), "drift", LINEAR),
    Way(("state_space", "observation_space", "domain", "x_min", "x_max"), "drift", BOX),
    Way(("constraints", "constraint", "state_constraints"), "drift", LIMITS),
    Way(("obstacle", "obstacles", "unsafe"), "exit_cost", OBSTACLE),
    Way(("obstacle", "obstacles", "unsafe", "avoid"), "tube", TUBE),
    Way(("targets",), "target", "the union of two targets is target=lambda x: jnp.minimum(first(x), second(x))"),
    Way(("final_cost", "end_cost", "terminal"), "terminal_cost", "did you mean terminal_cost?"),
    Way(("horizon", "t", "tf", "t_final", "time_horizon"), None, HORIZON),
    Way(("x0", "initial_state", "start_state"), None, START),
    Way(("dx", "h", "spacing", "step_size"), "shape", NODES),
    Way(("dt", "time_step", "step"), "drift", STEP),
    Way(("dt", "time_step", "step"), "hold", HOLD),
    Way(("boundary", "boundary_conditions", "bc", "boundaries"), "edges", ENDS),
    Way(("transition", "transitions", "p", "probabilities", "model"), "drift", TABLES),
    Way(("save", "savefig", "filename", "file", "path", "fname", "show"), "ax", PICTURE),
    Way(("figsize", "title", "cmap", "xlabel", "ylabel", "dpi"), "ax", CANVAS),
    Way(
        ("drift", "dynamics", "cost", "reward", "controls", "discount", "noise", "target", "terminal_cost"),
        "grid",
        PART,
    ),
)

RICCATI = (
    "not in hjbjax: scipy.linalg.solve_continuous_are; with bounds, hjb.solve(hjb.Problem(drift, cost, controls), grid)"
)
SYSTEM = "write the rate of change of the state as a function: hjb.Problem(lambda x, u: A @ x + B @ u, cost, controls)"
PLAN = (
    "hjb.solve(problem, grid) has the control for all states; hjb.pontryagin(problem, x0) has one path without a grid"
)
SET = "hjb.march(hjb.reach(drift, controls, target), grid, horizon); also hjb.avoid and hjb.reach_avoid"
DRAW = "hjb.plotting.value(solution), hjb.plotting.policy(solution), hjb.plotting.trajectory(path)"
LEARN = "hjbjax does not learn from samples: write the step as a drift, hjb.from_gymnasium(space) translates the spaces"


def _table(*entries: tuple[str, str]) -> dict[str, str]:
    """A table of words, each line of which has the words of one meaning."""
    return {word: advice for words, advice in entries for word in words.split()}


OF_PACKAGE = _table(
    ("lqr dlqr lqe care dare lqcontrol lqg place solve_discrete_riccati solve_continuous_are", RICCATI),
    ("ss statespace linearsystem tf transferfunction nlsys nonlinearsystem system dynamics", SYSTEM),
    ("mpc nmpc ocp solve_ocp optimal_control optimize minimize dynamic_programming", PLAN),
    ("value_iteration vfi", "hjb.solve(problem, grid, method=hjb.ValueIteration())"),
    ("policy_iteration howard modified_policy_iteration pfi", "hjb.solve(problem, grid, method=hjb.PolicyIteration())"),
    ("discretedp ddp mdp", "hjb.chain.transition_arrays(problem, grid) exports the arrays of a decision process"),
    ("markovchain stationary_distribution stationary_distributions", "hjb.chain.stationary_law(problem, grid, policy)"),
    ("tauchen rouwenhorst", "an income is a mode, hjb.Modes(names, rates=...), or a state with noise="),
    ("brt brs frt backwards_reachable_tube backward_reachable_tube reachable_set reachable_tube hjsolver", SET),
    ("hj_solve hjipde_solve step ttrsolver reachability", SET),
    ("sets", "hjb.Box(lo, hi), hjb.Ball(radius, dim), hjb.Simplex(dim), hjb.Finite(points)"),
    ("boundary_conditions extrapolate_away_from_zero", "hjb.Grid(..., edges='open') or edges='linear'"),
    ("solversettings with_accuracy", "hjb.march(..., scheme=hjb.Weno5()), hjb.Eno2() or hjb.Upwind()"),
    ("cbf safety_filter safe_control shield", "hjb.least_restrictive(tube, nominal)"),
    ("plot show visualize", DRAW),
    (
        "rollout sim integrate odeint solve_ivp run input_output_response",
        "hjb.simulate(problem, solution, x0, duration)",
    ),
    ("train learn fit_policy env make policy agent", LEARN),
    ("export save", "solution.save(path) and, for NumPy only, solution.export(path)"),
)
OF_ZOO = _table(
    ("cartpole cart_pole mountain_car mountaincar acrobot", "the page 'From Gymnasium' and its notebook write it"),
    ("inverted_pendulum", "did you mean pendulum?"),
    ("lqr lq lqg", "did you mean double_integrator_lq, stochastic_lq or lq_game?"),
    ("huggett aiyagari bewley income_fluctuation", "did you mean saving? Its market clears with hjb.equilibrium"),
    ("ramsey neoclassical cass_koopmans brock_mirman", "did you mean growth?"),
    ("air3d dubins_car dubins3d homicidal_chauffeur", "did you mean dubins or pursuit?"),
    ("black_scholes american_option put option", "did you mean american_put or perpetual_put?"),
    ("portfolio", "did you mean merton?"),
    ("rocket lunar_lander lander", "did you mean moon_landing?"),
    ("navigation river boat", "did you mean zermelo?"),
)
OF_PLOTTING = _table(
    ("plot contour contourf heatmap surface value_function imshow plot_value", "did you mean value?"),
    ("feedback control plot_policy quiver", "did you mean policy, over the states, or controls, over time?"),
    ("tube brt level_set contour3d isosurface", "did you mean zero_level_set or level_surface?"),
    ("path states simulation phase_portrait phase_plane", "did you mean trajectory or closed_loop?"),
    ("save savefig", "every function returns a picture: hjb.plotting.value(solution).save(path)"),
    ("show", "matplotlib.pyplot.show()"),
)
OF_SOLUTION = _table(
    ("v j values value_function fun vf", ".value has V at the nodes, .value_at(x) V between them"),
    (
        "u pi sigma action actions control controls controller feedback policy_at",
        ".policy, or .control_at(x) between nodes",
    ),
    ("gradient grad gradient_at grad_at dv costate p", ".costate_at(x) is the gradient of V"),
    ("success converged", ".status == hjb.Status.CONVERGED; solve raises an error if it does not converge"),
    ("nit num_iter n_iter iterations niter num_steps", ".steps"),
    ("history residual_history loss", ".residuals"),
    ("x states nodes s state", ".grid.nodes()"),
    ("plot show", DRAW),
    ("act get_action choose_action select_action", ".predict(x) returns (control, None); .control_at(x) the control"),
    ("interpolate interp eval evaluate", ".value_at(x) and .control_at(x)"),
    ("t ts time", ".times, of a march"),
    ("dump write to_file", ".save(path)"),
    ("simulate rollout", "hjb.simulate(problem, solution, x0, duration)"),
)
OF_GRID = _table(
    (
        "from_lattice_parameters_and_boundary_conditions from_lattice_parameters from_arrays linspace",
        "hjb.Grid(lo, hi, shape, periodic=(False, True), edges=...)",
    ),
    ("states x points mesh meshgrid", ".nodes() has all states, shape (*grid, n)"),
    (
        "coordinate_vectors coords coordinates vectors vs axes",
        ".axis(i) has the coordinates of the nodes along one axis",
    ),
    ("spacings dx h", ".spacing(i)"),
    ("ndims dim n dims", ".ndim"),
    ("grad_values upwind_grad_values gradient", "solution.costate_at(x) is the gradient of V"),
    ("min minimum lower low lbound", ".lo"),
    ("max maximum upper high ubound", ".hi"),
)
OF_PATH = _table(
    ("t time ts", ".times"),
    ("x y xs state trajectory outputs", ".states"),
    ("u us inputs actions control action", ".controls"),
    ("total_cost j value return rewards", ".cost, or .reward"),
    ("success", ".status"),
    ("plot", "hjb.plotting.trajectory(path) or hjb.plotting.controls(path)"),
)


def shown(value: object) -> str:
    """A value for a message: its ``repr`` on one line of at most ``SHOWN`` characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= SHOWN else text[: SHOWN - 4] + " ..."


def cure_of(word: str, by_name: Set[str]) -> str:
    """The advice for a keyword that a function with the keywords ``by_name`` does not have."""
    # running_cost means cost, although its spelling is closer to running_max
    parts = [part for part in word.split("_")[::-1] if part in by_name]
    elsewhere = [own for own in ELSEWHERE.get(word.lower(), ()) if own in by_name]
    for way in WAYS:
        # without a keyword that belongs to the word, another word for it in the function is better advice
        if word.lower() in way.words and (way.own in by_name or (way.own is None and not elsewhere)):
            return way.advice
    near = parts or elsewhere or difflib.get_close_matches(word, by_name)
    return f"did you mean {near[0]}?" if near else f"wanted one of {', '.join(sorted(by_name - {'self'}))}"


def missing(owner: str, name: str, table: dict[str, str], known: Iterable[str] = ()) -> str:
    """The message of an ``AttributeError``, with the way out if the name is a word of others or close to a known one.

    Args:
      owner: the module or object, as Python writes it.
      name: the attribute that does not exist.
      table: the words in lower case and the advice for them.
      known: names to compare the spelling with.
    """
    advice = table.get(name.lower(), "")
    if not advice and (near := difflib.get_close_matches(name, list(known))):
        advice = f"did you mean {near[0]}?"
    return f"{owner} has no attribute {name!r}" + (f": {advice}" if advice else "")
