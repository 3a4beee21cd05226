"""Blocks of states that do not interact, and the problem of each block.

A function of the problem is split into parts by ``separation``. The states that a part reads, together with all states
that the drift of these states reads, form a self-contained subsystem; its controls and disturbances are those that its
drift and its parts read. Subsystems that share an input are one block. Four rules put the values V_i together; L, ψ, l
and g are sums, maxima or minima of parts, one per block:

    sum     L and ψ are sums                                       V = Σ V_i
    max     ψ or g, or both, are maxima                            V = max_i V_i
    min     ψ or l, or both, are minima                            V = min_i V_i
    first   l is a maximum, and g is a maximum or absent           V(t, x) = min_s max_i V_i(x_i; s)

V_i(x_i; s) in the last rule belongs to reaching at the end of a horizon s, because all blocks must be inside at the
same moment. The rule is exact without disturbances. With them V is at most this number.

If subsystems share inputs, each V_i lets them act for its block alone. Sum, max and first are then lower bounds of V.
A minimum is exact without disturbances, and an upper bound with them.
Self-contained subsystems of reachability problems are due to M. Chen, S. L. Herbert, M. S. Vashishtha, S. Bansal and
C. J. Tomlin, Decomposition of reachable sets and tubes for a class of nonlinear systems, 2018.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hjbjax.decomposition.separation import (
    MAX,
    MIN,
    NONE,
    ONE,
    SUM,
    Inputs,
    Separated,
    merged,
    separated,
    structure,
    structure_for_any_leaves,
)
from hjbjax.problem.labels import REWARD
from hjbjax.problem.problem import Problem
from hjbjax.problem.pytree import is_traced, pytree_dataclass
from hjbjax.problem.sets import Box
from hjbjax.problem.settings import own_settings
from hjbjax.problem.types import Array

FIRST = "first"
PAID = ("cost", "reward")
ENDS = ("terminal_cost", "terminal_reward")
LIMITS = ("stopping_cost", "running_max")
REFUSED = {
    "target": "the target ends the path of all blocks at the same time; pose reachability by hjb.reach",
    "stopping_reward": "stopping ends the rewards of all blocks at the same time",
    "growth": "its payments grow at a common rate",
    "modes": "the mode is common to all states",
}


class Names(NamedTuple):
    """The numbers of states, controls and disturbances; inputs are numbered in this order."""

    n: int
    m: int
    k: int

    def of(self, inputs: Inputs) -> str:
        """Inputs in words, such as "x[0], u[1]"."""
        starts = {"x": 0, "u": self.n, "d": self.n + self.m}
        found = []
        for each in sorted(inputs):
            letter = "x" if each < self.n else "u" if each < self.n + self.m else "d"
            found.append(f"{letter}[{each - starts[letter]}]")
        return ", ".join(found)


@dataclasses.dataclass(frozen=True)
class Block:
    """A self-contained subsystem.

    Attributes:
      states, controls, disturbances: the numbers of its states, controls and disturbances in the whole problem.
      keys: the inputs of the parts that belong to it.
    """

    states: tuple[int, ...]
    controls: tuple[int, ...]
    disturbances: tuple[int, ...]
    keys: frozenset[Inputs]


@dataclasses.dataclass(frozen=True)
class Blocks:
    """The blocks of a problem, the rule that puts their values together, and the side of V if it is only a bound."""

    rule: str
    blocks: tuple[Block, ...]
    bound: str | None


def find_blocks(problem: Problem, n: int, *, bound: bool) -> Blocks:
    """The blocks of a problem with n states.

    Args:
      problem: a problem whose functions are pytrees.
      n: the number of states.
      bound: True if subsystems may share inputs, so that the result may be a bound of V.

    Raises:
      ValueError: the problem does not separate; the message names the coupling.
    """
    _check_ingredients(problem)
    m, k = (0 if each is None else each.dim for each in (problem.controls, problem.disturbances))
    names = Names(n, m, k)
    with own_settings(x64=None if is_traced(problem) else True):
        reads = _drift_reads(problem, names)
        found = {name: _split(problem, name, names) for name in (*PAID, *ENDS, *LIMITS) if _varies(problem, name)}
    if not found:
        raise ValueError("decompose: the problem has no cost that depends on the state; V is a number")
    rule = _rule(problem, found, names)
    keys = {key for each in found.values() for key in each.parts if key}
    whole = [(_closure(key, reads, n), frozenset({key})) for key in sorted(keys, key=sorted)]
    groups = _contained(whole) if bound else whole
    groups = _with_states(_joined_groups(groups, _common(problem, names), share=bound), names)
    if len(groups) < 2:
        raise ValueError(_coupling(problem, reads, found, names, bound))
    shared = frozenset().union(*(a & b for (a, _), (b, _) in itertools.combinations(groups, 2)))
    side = _side(problem, rule, shared, names)
    if side is not None and not bound:
        why = "of an obstacle that is an intersection" if rule == MIN else "of a game into an intersection"
        raise ValueError(f"decompose: the values of the blocks {why} only give an {side} bound of V; pass bound=True")
    return Blocks(rule, tuple(_block(inputs, keys, names) for inputs, keys in groups), side)


def _check_ingredients(problem: Problem) -> None:
    """Refuse a problem that has no decomposition, with the reason."""
    for name, why in REFUSED.items():
        if getattr(problem, name) is not None:
            raise ValueError(f"decompose: got a problem with {name}, which couples the blocks: {why}")
    for name in ("jumps", "pushes"):
        if getattr(problem, name):
            raise ValueError(f"decompose: got a problem with {name}, wanted one without; solve it on one grid")
    if callable(problem.discount):
        raise ValueError("decompose: got a discount that is a function of the state, wanted a number")
    if callable(problem.controls):
        raise ValueError("decompose: got bounds of the controls that depend on the state, wanted a fixed set")


def _varies(problem: Problem, name: str) -> bool:
    """True if an ingredient is a function."""
    return callable(getattr(problem, name))


def _arguments(problem: Problem, name: str, names: Names) -> tuple[list[tuple[int, ...]], list[int | None]]:
    """The shapes of a function's arguments, and the number of the first input of each."""
    of_action = name in ("drift", "noise", *PAID)
    shapes: list[tuple[int, ...]] = [()] * problem.time_dependent + [(names.n,)]
    first: list[int | None] = [None] * problem.time_dependent + [0]
    if of_action:
        shapes += [(names.m,)] + [(names.k,)] * problem.is_game
        first += [names.n] + [names.n + names.m] * problem.is_game
    return shapes, first


def _drift_reads(problem: Problem, names: Names) -> list[Inputs]:
    """The inputs that the drift, and the noise, of every state read."""
    rows = structure(problem.drift, *_arguments(problem, "drift", names))
    if len(rows) != names.n:
        raise ValueError(f"decompose: the drift has {len(rows)} entries, wanted {names.n}, the number of states")
    reads = [each.inputs for each in rows]
    if callable(problem.noise):
        entries = structure(problem.noise, *_arguments(problem, "noise", names))
        per_row = max(1, len(entries) // names.n)
        for i in range(names.n):
            own = entries[i * per_row : (i + 1) * per_row] if len(entries) > 1 else entries
            reads[i] = reads[i].union(*(each.inputs for each in own))
    return reads


def _split(problem: Problem, name: str, names: Names) -> Separated:
    """A payment or a distance, separated, without numbers."""
    entries = structure(getattr(problem, name), *_arguments(problem, name, names))
    if len(entries) != 1:
        raise ValueError(f"decompose: Problem.{name} returns {len(entries)} numbers, wanted one")
    return entries[0]


def _rule(problem: Problem, found: dict[str, Separated], names: Names) -> str:
    """The rule that puts the values of the blocks together."""
    kinds = {name: each.kind for name, each in found.items() if each.kind != ONE}
    limited = any(getattr(problem, name) is not None for name in LIMITS)
    if not limited and set(kinds.values()) <= {SUM}:
        return SUM
    what = ", ".join(f"{name} is a {kind}" for name, kind in kinds.items())
    running = any(getattr(problem, name) is not None for name in PAID)
    random = problem.noise is not None
    if running or random or problem.payoff == REWARD or problem.discount != 0:
        why = (
            "noise"
            if random
            else "rewards"
            if problem.payoff == REWARD
            else "a running cost"
            if running
            else "a discount"
        )
        raise ValueError(
            f"decompose: {what or 'there are tubes'}, together with {why}; wanted sums, or maxima and minima of "
            "distances only.\nThe value of a maximum of random or accumulated costs does not separate"
        )
    stops, tops = found.get("stopping_cost"), found.get("running_max")
    ends = found.get("terminal_cost")
    inner = {each.kind for each in (stops, ends) if each is not None} - {ONE}
    outer = {tops.kind} - {ONE} if tops is not None else set()
    if inner <= {MIN} and tops is None:
        return MIN
    if stops is None and inner | outer <= {MAX}:
        return MAX
    if stops is not None and ends is None and inner | outer <= {MAX}:
        return FIRST
    if stops is None and ends is None and outer == {MIN}:
        return MIN
    raise ValueError(
        f"decompose: {what}, which is not one of the combinations that separate: sums; maxima of distances, of\n"
        "obstacles, or of both; and minima of targets without obstacles. Write a union by jnp.minimum, an\n"
        "intersection by jnp.maximum"
    )


def _closure(key: Inputs, reads: Sequence[Inputs], n: int) -> Inputs:
    """The inputs of the self-contained subsystem of some inputs."""
    inputs, size = key, -1
    while len(inputs) != size:
        size = len(inputs)
        inputs = inputs.union(*(reads[i] for i in inputs if i < n))
    return inputs


Group = tuple[Inputs, frozenset[Inputs]]  # the inputs of a subsystem, and the inputs of each of its parts


def _contained(groups: Sequence[Group]) -> list[Group]:
    """The largest subsystems, with the parts of the subsystems inside them."""
    largest = {inputs for inputs, _ in groups if not any(inputs < other for other, _ in groups)}
    found: dict[Inputs, frozenset[Inputs]] = dict.fromkeys(sorted(largest, key=sorted), frozenset())
    for inputs, keys in groups:
        home = next(each for each in found if inputs <= each)
        found[home] |= keys
    return list(found.items())


def _common(problem: Problem, names: Names) -> list[Inputs]:
    """The inputs that a set couples: all controls unless they are in a box, and likewise the disturbances."""
    m, first = names.m, names.n
    found = []
    for admissible, start, count in ((problem.controls, first, m), (problem.disturbances, first + m, names.k)):
        if admissible is not None and not isinstance(admissible, Box):
            found.append(frozenset(range(start, start + count)))
    return found


def _joined_groups(groups: Sequence[Group], common: Sequence[Inputs], *, share: bool) -> list[Group]:
    """Join the groups that share inputs, unless ``share`` allows this, and the groups whose inputs a set couples."""
    found: list[Group] = []
    for inputs, keys in groups:
        inputs = inputs.union(*(each for each in common if inputs & each))
        rest = []
        for other in found:
            if any(inputs & other[0] & each for each in common) or (not share and inputs & other[0]):
                inputs, keys = inputs | other[0], keys | other[1]
            else:
                rest.append(other)
        found = [*rest, (inputs, keys)]
    # a group that has grown may now meet an earlier one
    return found if len(found) == len(groups) else _joined_groups(found, common, share=share)


def _with_states(groups: Sequence[Group], names: Names) -> list[Group]:
    """The groups that have states; the first one also gets the inputs that drive no state, or are not used at all."""
    found = sorted((group for group in groups if any(i < names.n for i in group[0])), key=lambda group: min(group[0]))
    if not found:
        return []
    used = frozenset().union(*(inputs for inputs, _ in found))
    idle = frozenset(range(names.n, names.n + names.m + names.k)) - used
    keys = frozenset().union(*(keys for _, keys in groups)) - frozenset().union(*(keys for _, keys in found))
    return [(found[0][0] | idle, found[0][1] | keys), *found[1:]]


def _side(problem: Problem, rule: str, shared: Inputs, names: Names) -> str | None:
    """ "lower" or "upper" if the combined value is only a bound of V; ``None`` if it is V."""
    tops_only = rule == MIN and problem.running_max is not None
    if not shared:
        return "upper" if tops_only or (rule == FIRST and problem.is_game) else None
    if rule == MIN and (tops_only or problem.is_game):
        return "upper"
    if rule == MIN:
        return None
    if problem.is_game and rule in (SUM, FIRST):
        raise ValueError(
            f"decompose: the blocks share {names.of(shared)} in a game, where the combined value is not a bound of V"
        )
    return "lower" if problem.payoff != REWARD else "upper"


def _block(inputs: Inputs, keys: frozenset[Inputs], names: Names) -> Block:
    """The block of a group."""
    n, m = names.n, names.m
    states, controls, disturbances = (
        tuple(sorted(i - start for i in inputs if start <= i < stop))
        for start, stop in ((0, n), (n, n + m), (n + m, n + m + names.k))
    )
    return Block(states, controls, disturbances, keys)


def _coupling(problem: Problem, reads: Sequence[Inputs], found: dict[str, Separated], names: Names, bound: bool) -> str:
    """The message about a problem that does not separate."""
    couplings: list[tuple[str, Inputs]] = []  # in words, and the inputs that are coupled
    for i, each in enumerate(reads):
        others = frozenset(j for j in each if j < names.n and j != i)
        if others:
            couplings.append((f"the drift of x[{i}] reads {names.of(others)}", others | {i}))
    for name, whole in found.items():
        for key in sorted(whole.parts, key=sorted):
            if len([j for j in key if j < names.n]) > 1:
                couplings.append((f"{name} has a term that reads {names.of(key)} together", key))
    for j in range(names.n, names.n + names.m + names.k):
        rows = frozenset(i for i, each in enumerate(reads) if j in each)
        if rows:
            driven = f"{names.of(frozenset({j}))} drives {names.of(rows)}"
            couplings.append((driven if len(rows) > 1 else "", rows | {j}))
    couplings += [("a set that is not a Box couples all its inputs", each) for each in _common(problem, names)]
    lines = [f"  {words}" for words in _most_separating_first(couplings, names.n) if words]
    lines = [*lines[:6], *(["  and others"] if len(lines) > 6 else [])]
    if not bound:
        lines.append("Solve it on one grid, or pass bound=True to let subsystems share states and inputs.")
    return "\n".join([f"decompose: the {names.n} states are one block, so there is nothing to decompose:", *lines])


def _most_separating_first(couplings: Sequence[tuple[str, Inputs]], n: int) -> list[str]:
    """The couplings in words, in the order of the largest block of states that would remain without each."""

    def largest_without(left_out: int) -> int:
        blocks = [frozenset({i}) for i in range(n)]
        for i, (_, inputs) in enumerate(couplings):
            if i != left_out:
                meeting = [each for each in blocks if each & inputs]
                blocks = [each for each in blocks if not each & inputs] + [inputs.union(*meeting)]
        return max(sum(i < n for i in each) for each in blocks)

    order = sorted(range(len(couplings)), key=largest_without)  # stable: equal ones stay in the order of the states
    return [couplings[i][0] for i in order]


class _Fixed:
    """A function whose leaves are constants of compiled programs, because they decide how it separates."""

    def __init__(self, function: Any):
        self.function = function
        leaves, structure = jax.tree.flatten(function)
        self._key = (structure, tuple((np.shape(leaf), np.asarray(leaf, float).tobytes()) for leaf in leaves))

    def __call__(self, *arguments: Array) -> Any:
        return self.function(*arguments)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Fixed) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@pytree_dataclass(static=("names", "block", "timed", "rows", "sizes"))
class BlockFunction:
    """A function of the problem, restricted to the inputs of one block.

    Args:
      function: the function of the whole problem.
      sizes: the number of entries of each of its arguments, except the time.
      names: the numbers of states, controls and disturbances.
      block: the block.
      timed: True if the time comes first.
      rows: True for the rows of the drift or the noise that belong to the states of the block, False for the part of a
        payment or a distance.
    """

    function: Any
    sizes: tuple[int, ...]
    names: Names
    block: Block
    timed: bool
    rows: bool

    def __call__(self, *arguments: Array) -> jax.Array:
        """The rows, or the part."""
        own = (self.block.states, self.block.controls, self.block.disturbances)
        time, rest = arguments[: self.timed], arguments[self.timed :]
        dtype = jnp.asarray(rest[0]).dtype
        whole = []
        for i, (size, places) in enumerate(zip(self.sizes, own, strict=False)):
            zeros = jnp.zeros(size, dtype)  # a block without disturbances has no argument for them
            whole.append(zeros.at[np.array(places, int)].set(rest[i]) if places else zeros)
        if self.rows:
            return _rows(jnp.asarray(self.function(*time, *whole)), self.block.states)
        first: list[int | None] = [None] * self.timed + [0, self.names.n, self.names.n + self.names.m][: len(whole)]
        (value,) = separated(self.function, (*time, *whole), first).reshape(-1)
        found = merged(value, (self.block.keys | {NONE}).__contains__)
        assert found is not None
        return jnp.asarray(found)


def _rows(values: jax.Array, states: Sequence[int]) -> jax.Array:
    """The rows of the drift or the noise of some states; a noise that is one number is the same for all."""
    return values if values.ndim == 0 else values[np.array(states, int)]


def block_problem(problem: Problem, blocks: Blocks, index: int, n: int) -> Problem:
    """The problem of one block."""
    block = blocks.blocks[index]
    m, k = (0 if each is None else each.dim for each in (problem.controls, problem.disturbances))
    names = Names(n, m, k)

    def rows(name: str) -> Any:
        function = getattr(problem, name)
        if not callable(function):
            return None if function is None else np.asarray(_rows(jnp.asarray(function), block.states))
        sizes = tuple(shape[0] for shape in _arguments(problem, name, names)[0] if shape)
        return BlockFunction(function, sizes, names, block, problem.time_dependent, True)

    def part(name: str) -> Any:
        function = getattr(problem, name)
        if not callable(function):
            return function if index == 0 or blocks.rule != SUM else None
        shapes, first = _arguments(problem, name, names)
        with own_settings(x64=None if is_traced(problem) else True):
            (found,), (blind,) = (each(function, shapes, first) for each in (structure, structure_for_any_leaves))
        of_no_block = not found.inputs and index == 0
        if not of_no_block and not block.keys & found.parts.keys():
            return None
        if found != blind and not is_traced(function):
            function = jax.tree_util.Partial(_Fixed(function))
        sizes = tuple(shape[0] for shape in shapes if shape)
        return BlockFunction(function, sizes, names, block, problem.time_dependent, False)

    parts = {name: part(name) for name in (*PAID, *ENDS, *LIMITS)}
    if blocks.rule == FIRST:  # the block is inside at the end of the horizon, and the moment is chosen for all together
        parts["terminal_cost"] = parts.pop("stopping_cost")
    return Problem(
        rows("drift"), controls=_part_of_set(problem.controls, block.controls, m),
        disturbances=_part_of_set(problem.disturbances, block.disturbances, k), noise=rows("noise"),
        discount=problem.discount, isaacs=problem.isaacs, time_dependent=problem.time_dependent, inside=problem.inside,
        control_names=[problem.control_names[j] for j in block.controls] if problem.control_names else (),
        control_units=[problem.control_units[j] for j in block.controls] if problem.control_units else (),
        time_unit=problem.time_unit, **parts,
    )  # fmt: skip


def _part_of_set(admissible: Any, places: tuple[int, ...], count: int) -> Any:
    """The admissible set of some inputs."""
    if admissible is None or not places:
        return None
    if len(places) == count:
        return admissible
    where = np.array(places, int)
    return Box(np.asarray(admissible.lo)[where], np.asarray(admissible.hi)[where])
