"""Refusal of costs that accumulate forever: no discount, and nothing that ends a path or lets it rest."""

from hjbjax.problem.grid import Grid
from hjbjax.problem.problem import Problem
from hjbjax.problem.sets import Finite


def ill_posed(problem: Problem, has_rest: bool, grid: Grid) -> None:
    """Refuse an infinite sum of costs: no discount, and nothing that ends the path or lets it rest at no cost.

    Args:
      problem: the problem.
      has_rest: True if there is a node where the system can rest at no cost.
      grid: the nodes; if none is in the middle of the box, the message suggests a shape with a node there.

    Raises:
      ValueError: there is no finite solution; the message lists remedies.
    """
    # with any of these the cost of a path may be finite; the solve will find out
    ends = (problem.target, problem.stopping_cost, problem.running_max)
    if problem.discount > 0 or has_rest or any(end is not None for end in ends):
        return
    word = problem.labels.word
    moved = problem.is_game or isinstance(problem.controls, Finite)
    raise ValueError(
        f"Problem: on this grid there is no finite solution: discount = 0, and the {word('cost')} accumulates forever: "
        f"there is\nno target, no {word('stopping_cost')}, no running_max and no node where the system can rest at no "
        f"{word('cost')}.\nGive discount > 0, or a target, or put a rest point (drift 0 and {word('cost')} 0 for some "
        "control) on a node,\nor march over a finite horizon" + _middle(grid) + (_near(problem) if moved else "")
    )


def _near(problem: Problem) -> str:
    """Advice where a path stays near a state by one action after the other, which a grid does not resolve."""
    who = "the disturbance moves it" if problem.is_game else "every action of the Finite set moves it"
    return (
        f".\nIf the system can only stay near a state because {who}, a target around this state ends the path: two or "
        "more cells wide"
    )


def _middle(grid: Grid) -> str:
    """Advice on the shape that puts a node in the middle of the box: even on a periodic axis, odd on another."""
    shape = tuple(
        count - (count % 2 if cyclic else 1 - count % 2)
        for count, cyclic in zip(grid.shape, grid.periodic, strict=True)
    )
    if shape == grid.shape or min(shape) < 2:  # there is a node already, or an axis of two points would lose one
        return ""
    return f".\nNo node is in the middle of the box, such as 0 on [-1, 1]; shape={shape} puts one there"
