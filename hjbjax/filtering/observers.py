"""What a controller without the state is given: an observer, whose state takes the place of the system's.

The information state at time t is all that the controls and the measurements up to t say about x(t); a controller is a
function of it. Certainty equivalence is ``lambda state: solution.control_at(observer.estimate(state))``.
"""

from typing import Any, Protocol, runtime_checkable

from hjbjax.problem.types import Array, Control, Number, State


@runtime_checkable
class Observer(Protocol):
    """A state estimator in discrete steps; its methods are pure, and ``update`` and ``estimate`` may be compiled."""

    def initial(self) -> Any:
        """The information state at t = 0, any pytree of arrays."""

    def update(self, state: Any, u: Control, dy: Array, dt: Number) -> Any:
        """The information state after holding the control u (m,) for a time dt and seeing the increment dy (p,)."""

    def estimate(self, state: Any) -> State:
        """The point estimate of x, shape (n,)."""
