"""Words that users bring from other packages and books: supported, or refused with the way out.

Nothing is compiled: each call ends before a solve starts.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb
from hjbjax.feedback.path import Path
from hjbjax.problem import words
from hjbjax.problem.pytree import pytree_dataclass, with_ways_out


class Space:
    """The attributes by which a space of Gymnasium is recognised."""

    low, high, shape = np.float32([-2]), np.float32([2]), (1,)
    contains = sample = seed = None


class Environment:
    action_space = observation_space = Space()


def f(x, u):
    return jnp.stack([x[1], u[0]])


def cost(x, u):
    return x @ x + u @ u


def first(x):
    return x[0]


U, G = hjb.Box([-1.0], [1.0]), hjb.Grid([-1, -1], [1, 1], (5, 5))
P = hjb.Problem(f, cost, U, discount=1.0)
S = hjb.Solution(G, np.zeros(G.shape), np.zeros((*G.shape, 1)))
PATH = Path(np.zeros(2), np.zeros((2, 2)), np.zeros((1, 1)), None, 0.0, None, 0, 1)
RATE = r"discount=hjb\.discount_rate\(gamma, dt\)"
REFUSED = {
    "gamma=": (lambda: hjb.Problem(f, cost, U, gamma=0.99), RATE),
    "beta=": (lambda: hjb.Problem(f, cost, U, beta=0.99), RATE),
    "discount_factor=": (lambda: hjb.Problem(f, cost, U, discount_factor=0.99), RATE),
    "maximize=": (lambda: hjb.Problem(f, cost, U, maximize=True), "write reward= instead of cost="),
    "sense=": (lambda: hjb.Problem(f, cost, U, sense="max"), "write reward= instead of cost="),
    "cost and reward": (lambda: hjb.Problem(f, cost, U, reward=cost), "wanted only costs or only rewards"),
    "utility=": (lambda: hjb.Problem(f, utility=cost, controls=U), r"did you mean reward\?"),
    "running_cost=": (lambda: hjb.Problem(f, running_cost=cost), r"did you mean cost\?"),
    "final_cost=": (lambda: hjb.Problem(f, cost, U, final_cost=first), r"did you mean terminal_cost\?"),
    "sigma=": (lambda: hjb.Problem(f, cost, U, sigma=0.1), r"did you mean noise\?"),
    "dynamics=": (lambda: hjb.Problem(dynamics=f), r"did you mean drift\?"),
    "transition=": (lambda: hjb.Problem(transition=f), "wanted drift=, the rate of change"),
    "a space as controls": (lambda: hjb.Problem(f, cost, Space()), r"hjb\.from_gymnasium\(space\)"),
    "action_space=": (lambda: hjb.Problem(f, cost, action_space=Space()), r"controls=hjb\.from_gymnasium"),
    "a space as a grid": (lambda: hjb.solve(P, Space()), r"hjb\.from_gymnasium\(space, shape\)"),
    "an environment": (lambda: hjb.Problem(Environment(), cost, U), "write the step of the environment as"),
    "state_space=": (lambda: hjb.Problem(f, cost, U, state_space=Space()), "belongs to the grid"),
    "a point as target": (lambda: hjb.Problem(f, cost, U, target=[0, 0]), r"norm\(x - point\) - radius"),
    "several targets": (lambda: hjb.Problem(f, cost, U, target=[first, first]), r"jnp\.minimum\(first\(x\), second"),
    "targets=": (lambda: hjb.Problem(f, cost, U, targets=[first]), r"jnp\.minimum\(first\(x\), second"),
    "obstacle=": (lambda: hjb.Problem(f, cost, U, obstacle=first), "a target with a large exit_cost"),
    "constraints=": (lambda: hjb.Problem(f, cost, U, constraints=first), "edges='constrained'"),
    "u_min=": (lambda: hjb.Problem(f, cost, u_min=-1, u_max=1), r"controls=hjb\.Box\(lo, hi\)"),
    "a pair as controls": (lambda: hjb.Problem(f, cost, (-1, 1)), r"hjb\.Box\(-1, 1\)"),
    "values as controls": (lambda: hjb.Problem(f, cost, np.linspace(-1, 1, 5)), r"hjb\.Finite\(values\[:, None\]\)"),
    "a list as controls": (lambda: hjb.Problem(f, cost, [-1, 0, 1]), r"hjb\.Finite\(values\[:, None\]\)"),
    "Finite([..])": (lambda: hjb.Finite([-1, 0, 1]), r"as in hjb\.Finite\(\[\[-1\.0\], \[0\.0\], \[1\.0\]\]\)"),
    "Box([lo, hi])": (lambda: hjb.Box([-1, 1]), r"hjb\.Box\(-1, 1\)"),
    "jumps=function": (lambda: hjb.Problem(f, cost, U, jumps=f), r"\[hjb\.Jump\(rate, landing\)\]"),
    "modes=2": (lambda: hjb.Problem(f, cost, U, modes=2), r"hjb\.Modes\(\('low', 'high'\), rates=\.\.\.\)"),
    "solve(horizon=)": (lambda: hjb.solve(P, G, horizon=1.0), r"hjb\.march\(problem, grid, horizon\)"),
    "Problem(horizon=)": (lambda: hjb.Problem(f, cost, U, horizon=1.0), r"hjb\.march\(problem, grid, horizon\)"),
    "march(T=)": (lambda: hjb.march(P, G, T=1.0), r"did you mean horizon\?"),
    "simulate(T=)": (lambda: hjb.simulate(P, S, [0, 0], T=1.0), r"did you mean duration\?"),
    "solve(x0=)": (lambda: hjb.solve(P, G, x0=[0, 0]), r"hjb\.simulate\(problem, solution, x0, duration\)"),
    "Problem(dt=)": (lambda: hjb.Problem(f, cost, U, dt=0.1), "time is continuous"),
    "method='...'": (lambda: hjb.solve(P, G, method="policy"), r"wanted hjb\.PolicyIteration\(\.\.\.\)"),
    "scheme='...'": (lambda: hjb.solve(P, G, scheme="weno"), r"wanted hjb\.Upwind\(\)"),
    "Grid(dx=)": (lambda: hjb.Grid([-1], [1], dx=0.1), "wanted the number of nodes per axis"),
    "Grid(boundary=)": (lambda: hjb.Grid([-1], [1], (5,), boundary="open"), "wanted edges=: 'projected'"),
    "Grid(periodic=True)": (lambda: hjb.Grid([-1], [1], (5,), periodic=True), "one bool per axis"),
    "control_space=": (lambda: hjb.Problem(f, cost, control_space=U), r"controls=hjb\.Box\(lo, hi\)"),
    "disturbance_space=": (lambda: hjb.Problem(f, cost, U, disturbance_space=U), r"disturbances=hjb\.Box"),
    "control_mode=": (lambda: hjb.Problem(f, cost, U, control_mode="max"), r"hjb\.avoid is 'max', 'min'"),
    "uMode=": (lambda: hjb.reach(f, U, first, uMode="max"), "the control minimises"),
    "Q=": (lambda: hjb.Problem(f, Q=np.eye(2)), r"cost=lambda x, u: x @ Q @ x \+ u @ R @ u"),
    "reach(obstacle=)": (lambda: hjb.reach(f, U, first, obstacle=first), r"hjb\.reach_avoid\(drift, controls, target"),
    "reach(array)": (lambda: hjb.reach(f, U, np.zeros((31, 31))), r"\.\.\., wanted a function of one state"),
    "solve(epsilon=)": (lambda: hjb.solve(P, G, epsilon=1e-3), r"did you mean tol\?"),
    "solve(verbose=)": (lambda: hjb.solve(P, G, verbose=True), r"did you mean progress\?"),
    "solve(cost=)": (lambda: hjb.solve(P, G, terminal_cost=first), r"belongs to the problem: hjb\.Problem"),
    "simulate(dt=)": (lambda: hjb.simulate(P, S, [0, 0], 1.0, dt=0.1), "hold=dt holds the control"),
    "simulate(seed=)": (lambda: hjb.simulate(P, S, [0, 0], 1.0, seed=0), r"did you mean key\?"),
    "value(save=)": (lambda: hjb.plotting.value(S, save="v.png"), r"has \.save\(path\)"),
    "value(figsize=)": (lambda: hjb.plotting.value(S, figsize=(6, 4)), "draw on axes of your own figure"),
    "predict(observation)": (
        lambda: S.predict([1.0, 0.0, 0.5]),
        r"wanted \(\.\.\., 2\): x1, x2\.\nIf the observation is not",
    ),
}
MISSING = {
    "hjb.lqr": (lambda: hjb.lqr, r"scipy\.linalg\.solve_continuous_are"),
    "hjb.StateSpace": (lambda: hjb.StateSpace, "write the rate of change of the state as a function"),
    "hjb.MPC": (lambda: hjb.MPC, r"hjb\.pontryagin\(problem, x0\)"),
    "hjb.value_iteration": (lambda: hjb.value_iteration, r"method=hjb\.ValueIteration\(\)"),
    "hjb.DiscreteDP": (lambda: hjb.DiscreteDP, r"hjb\.chain\.transition_arrays"),
    "hjb.MarkovChain": (lambda: hjb.MarkovChain, r"hjb\.chain\.stationary_law"),
    "hjb.tauchen": (lambda: hjb.tauchen, r"hjb\.Modes\(names, rates=\.\.\.\)"),
    "hjb.step": (lambda: hjb.step, r"hjb\.march\(hjb\.reach"),
    "hjb.sets": (lambda: hjb.sets.Box, r"hjb\.Box\(lo, hi\)"),
    "hjb.rollout": (lambda: hjb.rollout, r"hjb\.simulate\(problem, solution, x0, duration\)"),
    "hjb.train": (lambda: hjb.train, "does not learn from samples"),
    "hjb.plot": (lambda: hjb.plot, r"hjb\.plotting\.value\(solution\)"),
    "zoo.cart_pole": (lambda: hjb.zoo.cart_pole, "'From Gymnasium'"),
    "zoo.lqr": (lambda: hjb.zoo.lqr, r"did you mean double_integrator_lq, "),
    "zoo.huggett": (lambda: hjb.zoo.huggett, r"did you mean saving\?"),
    "zoo.pendulm": (lambda: hjb.zoo.pendulm, r"did you mean pendulum\?"),
    "plotting.contour": (lambda: hjb.plotting.contour, r"did you mean value\?"),
    "plotting.trajectry": (lambda: hjb.plotting.trajectry, r"did you mean trajectory\?"),
    "solution.V": (lambda: S.V, r"\.value_at\(x\)"),
    "solution.sigma": (lambda: S.sigma, r"\.control_at\(x\)"),
    "solution.grad": (lambda: S.grad, r"\.costate_at\(x\)"),
    "solution.success": (lambda: S.success, r"hjb\.Status\.CONVERGED"),
    "solution.act": (lambda: S.act, r"\.predict\(x\)"),
    "solution.plot()": (lambda: S.plot(), r"hjb\.plotting\.value\(solution\)"),
    "grid.states": (lambda: G.states, r"\.nodes\(\)"),
    "grid.coordinate_vectors": (lambda: G.coordinate_vectors, r"\.axis\(i\)"),
    "Path.y": (lambda: PATH.y, r"\.states"),
    "Path.inputs": (lambda: PATH.inputs, r"\.controls"),
}
SUPPORTED = {
    "reward=": lambda: hjb.Problem(f, reward=cost, controls=U).payoff == "reward",
    "Box([0], [inf])": lambda: hjb.Box([0], [np.inf]).unbounded,
    "discount=function": lambda: callable(hjb.Problem(f, cost, U, discount=lambda x: 1 + x @ x).discount),
    "controls=function": lambda: callable(hjb.Problem(f, cost, lambda x: hjb.Box(-x[:1], x[:1])).controls),
    "jumps=": lambda: len(hjb.Problem(f, cost, U, jumps=[hjb.Jump(1.0, lambda x, u: x)]).jumps) == 1,
    "modes=": lambda: (
        hjb.Problem(f, cost, U, modes=hjb.Modes(("a", "b"), rates=[[0, 1], [1, 0]])).modes.names[0] == "a"
    ),
    "controls=space": lambda: hjb.Problem(f, cost, hjb.from_gymnasium(Space())).controls.hi[0] == 2,
}


@pytest.mark.parametrize("word", REFUSED)
def test_a_word_is_answered_with_the_way_out(word):
    call, way = REFUSED[word]
    with pytest.raises((TypeError, ValueError), match=way) as caught:
        call()
    assert len(str(caught.value).splitlines()) <= 6


@pytest.mark.parametrize("word", MISSING)
def test_a_name_that_does_not_exist_is_answered_with_the_way_out(word):
    call, way = MISSING[word]
    with pytest.raises(AttributeError, match=f"has no attribute .*{way}"):
        call()


def test_no_word_hides_a_name_that_exists():
    for owner, table in (
        (hjb, words.OF_PACKAGE),
        (hjb.zoo, words.OF_ZOO),
        (hjb.plotting, words.OF_PLOTTING),
        (S, words.OF_SOLUTION),
        (G, words.OF_GRID),
        (PATH, words.OF_PATH),
    ):
        assert not [name for name in dir(owner) if name in table and not name.startswith("_")], owner


def test_names_without_advice_raise_as_usual():
    assert not hasattr(S, "__jax_array__")
    with pytest.raises(AttributeError, match=r"^'Solution' object has no attribute 'valeu'$") as caught:
        S.valeu  # noqa: B018
    assert (caught.value.name, caught.value.obj) == ("valeu", S)  # of which Python makes "did you mean 'value'?"


def test_an_error_inside_a_property_is_not_hidden():
    @with_ways_out({"cost": "somewhere else"})
    @pytree_dataclass()
    class Broken:
        x: float

        @property
        def cost(self):
            return self.x.nothing

    with pytest.raises(AttributeError, match="'float' object has no attribute 'nothing'"):
        Broken(1.0).cost  # noqa: B018


@pytest.mark.parametrize("word", SUPPORTED)
def test_a_word_is_supported(word):
    assert SUPPORTED[word]()
