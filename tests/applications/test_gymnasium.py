"""Feedbacks in the real environments of Gymnasium; ``python -m benchmarks agents`` plays 100 episodes of each."""

import json
from pathlib import Path

import pytest

import hjbjax as hjb
from benchmarks.accuracy import agents

ROOT = Path(__file__).parents[2]
ROWS = json.loads((ROOT / "benchmarks/results/agents.json").read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "nodes", "options", "seeds", "least"),
    [
        ("Pendulum-v1", 100, {"scheme": hjb.Upwind()}, 10, -150),  # exact dynamic programming: -129 from these seeds
        ("MountainCarContinuous-v0", 61, {"scheme": hjb.Upwind()}, 3, 97),
        ("CartPole-v1", 11, {}, 2, 500),
    ],
)
@pytest.mark.filterwarnings("ignore::hjbjax.SolveWarning")  # coarse grids
def test_feedbacks_earn_what_good_agents_earn(environment, nodes, options, seeds, least):
    pytest.importorskip("gymnasium")
    agent = agents.AGENTS[environment](nodes)
    solution = hjb.solve(agent.problem, agent.grid, **options)
    assert agents.play(environment, agent.policy(solution), seeds).mean() >= least


def test_the_table_of_the_page_is_what_the_benchmark_wrote():
    page = (ROOT / "docs/gymnasium.md").read_text(encoding="utf-8")
    assert {row["environment"] for row in ROWS} == set(agents.AGENTS)
    for row in ROWS:
        assert row["episodes"] == 100
        assert agents.quoted(row) in page.splitlines()
