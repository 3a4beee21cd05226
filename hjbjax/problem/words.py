"""Words of other packages and books: the names used here, or how to write what they mean.

A keyword that a function does not have is refused with the name used here, and with an example if it means something
else here.
"""

ELSEWHERE = {  # names of arguments in other packages and books, and the names used here
    **dict.fromkeys(("dynamics", "f", "ode", "fun"), ("drift",)),
    **dict.fromkeys(("loss", "l", "lagrangian"), ("cost",)),
    **dict.fromkeys(("utility", "profit", "payoff", "flow_payoff", "income", "return_function"), ("reward",)),
    **dict.fromkeys(("bequest", "scrap_value", "terminal_value", "terminal_utility"), ("terminal_reward",)),
    **dict.fromkeys(("exercise", "stopping_payoff", "stopping_value"), ("stopping_reward",)),
    **dict.fromkeys(("gamma", "beta", "rho", "rate", "mortality", "hazard", "short_rate"), ("discount",)),
    **dict.fromkeys(("u", "action", "actions", "input", "inputs"), ("controls",)),
    **dict.fromkeys(("d", "adversary", "opponent"), ("disturbances",)),
    **dict.fromkeys(("sigma", "diffusion", "epsilon"), ("noise",)),
    **dict.fromkeys(("tolerance", "eps", "atol", "threshold"), ("tol",)),
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

RATE = "discount is a rate per unit time; a factor gamma per step of length dt is discount=hjb.discount_rate(gamma, dt)"
MAXIMISE = "to maximise, write reward= instead of cost="
BOUNDS = "wanted controls=hjb.Box(lo, hi)"
BOX = "the range of the states belongs to the grid: hjb.solve(problem, hjb.Grid(lo, hi, shape))"
LIMITS = (
    "the ends of the box are limits with hjb.Grid(..., edges='constrained'); another forbidden set is a target with a\n"
    "large exit_cost; bounds of controls may depend on the state: controls=lambda x: hjb.Box(lo(x), hi(x))"
)
OBSTACLE = (
    "an obstacle is a target with a large exit_cost, such as 1e3; for a target and an obstacle join both by\n"
    "jnp.minimum and make exit_cost a function. Reachable sets: hjb.reach_avoid(drift, controls, target, obstacle)"
)
HORIZON = "a finite horizon belongs to hjb.march(problem, grid, horizon), with Problem(terminal_cost=...)"
START = "V is computed for all states; follow a path with hjb.simulate(problem, solution, x0, duration)"
NODES = "wanted the number of nodes per axis, shape=(41, 41); the ends of the box are nodes"
STEP = "time is continuous: write the rate of change; hjb.simulate(..., hold=dt) holds the control for a step"
ENDS = "wanted edges=: 'projected', 'constrained', 'open', 'linear', hjb.Dirichlet(value), hjb.Neumann(slope)"
TABLES = "wanted drift=, the rate of change of the state; hjb.chain.transition_arrays exports the probabilities"

# a word: the keyword that a function must have for the advice to apply, None for any function; and the advice
WAYS: dict[str, tuple[str | None, str]] = {
    **dict.fromkeys(("gamma", "beta", "discount_factor"), ("discount", RATE)),
    **dict.fromkeys(("maximize", "maximise", "minimize", "minimise", "sense"), ("reward", MAXIMISE)),
    "action_space": ("controls", "wanted controls=hjb.from_gymnasium(env.action_space)"),
    **dict.fromkeys(("u_min", "u_max", "umin", "umax", "bounds", "control_bounds"), ("controls", BOUNDS)),
    **dict.fromkeys(("state_space", "observation_space", "domain", "x_min", "x_max"), ("drift", BOX)),
    **dict.fromkeys(("constraints", "constraint", "state_constraints"), ("drift", LIMITS)),
    **dict.fromkeys(("obstacle", "obstacles", "unsafe"), ("exit_cost", OBSTACLE)),
    "targets": ("target", "the union of two targets is target=lambda x: jnp.minimum(first(x), second(x))"),
    **dict.fromkeys(("final_cost", "end_cost", "terminal"), ("terminal_cost", "did you mean terminal_cost?")),
    **dict.fromkeys(("horizon", "t", "tf", "t_final", "time_horizon"), (None, HORIZON)),
    **dict.fromkeys(("x0", "initial_state", "start_state"), (None, START)),
    **dict.fromkeys(("dx", "h", "spacing", "step_size"), ("shape", NODES)),
    **dict.fromkeys(("dt", "time_step", "step"), ("drift", STEP)),
    **dict.fromkeys(("boundary", "boundary_conditions", "bc", "boundaries"), ("edges", ENDS)),
    **dict.fromkeys(("transition", "transitions", "p", "probabilities", "model"), ("drift", TABLES)),
}
