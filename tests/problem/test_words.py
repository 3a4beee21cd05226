"""Words that users bring from other packages and books: supported, or refused with the way out.

Nothing is compiled: each call ends before a solve starts.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import hjbjax as hjb


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


@pytest.mark.parametrize("word", SUPPORTED)
def test_a_word_is_supported(word):
    assert SUPPORTED[word]()
