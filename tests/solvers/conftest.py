"""What tests of several front doors look at."""

import pytest

from hjbjax.solvers import stationary_run


@pytest.fixture
def iterations(monkeypatch):
    """The schemes and shapes of all iterations on the host."""
    seen, run = [], stationary_run.StationaryRun.__init__

    def noted(self, task, *rest):
        scheme = task.scheme.chain if task.is_chain else task.scheme
        seen.append((type(scheme).__name__, task.grid.shape))
        run(self, task, *rest)

    monkeypatch.setattr(stationary_run.StationaryRun, "__init__", noted)
    return seen
