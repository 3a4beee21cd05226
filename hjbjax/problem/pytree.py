"""Frozen dataclasses that are JAX pytrees.

Fields are of three kinds: leaves (numbers and arrays that can be swept, batched or differentiated), static fields (part
of the structure, so a change may recompile) and host fields (timings and histories, dropped when the object is
flattened and reset to their defaults when it is rebuilt). Rebuilding never runs ``__post_init__``, because its checks
would fail on tracers and stacked arrays.
"""

import copy
import dataclasses
import functools
import hashlib
import inspect
import re
from collections.abc import Callable, Iterable, Sequence, Set
from typing import Any, ParamSpec, TypeVar, dataclass_transform

import jax
import numpy as np

from hjbjax.problem.settings import own_settings, refuse_error_checks
from hjbjax.problem.types import DType, Numbers
from hjbjax.problem.words import cure_of, missing, shown

P = ParamSpec("P")
T = TypeVar("T")
# the start of an error message of a function that other public functions call
INNER = re.compile(r"^(lane \d+: )?(?:solve|solve_batch|march|reach_probability|pontryagin): ")
INTERRUPT = re.compile(r"\nKeyboardInterrupt\b.*\s*\Z")  # end of a traceback in the text of an XLA error
REMEMBERED = 256  # the number of most recent answers to keep per function; their keys hold functions and arrays


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field,))
def pytree_dataclass(*, static: Iterable[str] = (), host: Iterable[str] = ()) -> Callable[[type[T]], type[T]]:
    """Class decorator: a frozen dataclass, registered as a pytree node.

    Args:
      static: names of the fields that belong to the tree's structure; they must be hashable.
      host: names of the fields that do not survive flattening; they need defaults.

    Example:
      >>> @pytree_dataclass(static=("shape",))
      ... class Block:
      ...     scale: float
      ...     shape: tuple
      >>> jax.tree.map(lambda leaf: 2 * leaf, Block(3.0, (4,)))
      Block(scale=6.0, shape=(4,))
    """
    static, host = tuple(static), tuple(host)

    def register(cls: type[T]) -> type[T]:
        # eq=False: comparing field by field would need the truth value of an array
        cls = dataclasses.dataclass(frozen=True, eq=False, init="__init__" not in vars(cls))(cls)
        cls.__init__ = with_suggestions(cls.__init__, cls.__name__)  # type: ignore[method-assign]
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        unknown = {*static, *host} - {field.name for field in fields}
        if unknown:
            raise TypeError(f"{cls.__name__} has no field {', '.join(sorted(unknown))}")
        defaults = {field.name: _default(field) for field in fields if field.name in host}
        leaves = tuple(field.name for field in fields if field.name not in static + host)
        if not leaves and "__eq__" not in vars(cls):
            _compare_by_value(cls, static)

        keys = tuple(map(jax.tree_util.GetAttrKey, leaves))

        def flatten(self: Any) -> tuple[list[Any], tuple[Any, ...]]:
            return [getattr(self, name) for name in leaves], tuple([getattr(self, name) for name in static])

        # with keys, so that JAX names a leaf in its messages as the user does: ``.discount``
        def flatten_with_keys(self: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
            children, aux = flatten(self)
            return list(zip(keys, children, strict=True)), aux

        def unflatten(aux: tuple[Any, ...], children: Iterable[Any]) -> Any:
            self = object.__new__(cls)  # skips __init__ and the lock of a frozen dataclass
            values = vars(self)
            values.update(zip(leaves, children, strict=True))
            values.update(zip(static, aux, strict=True))
            for name, make in defaults.items():
                values[name] = make()
            return self

        jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
        return cls

    return register


def with_ways_out(table: dict[str, str]) -> Callable[[type[T]], type[T]]:
    """Class decorator: an attribute that does not exist is refused with the advice for its name in a table of words."""

    def register(cls: type[T]) -> type[T]:
        def find(self: Any, name: str) -> Any:
            if name.startswith("__") or hasattr(cls, name):
                return object.__getattribute__(self, name)  # raises again what a property raised
            message = missing(f"{cls.__name__!r} object", name, table)
            # from ``obj`` Python derives a suggestion of its own
            raise AttributeError(message, name=name, obj=None if name.lower() in table else self)

        cls.__getattr__ = find  # type: ignore[attr-defined]  # not a method, which would hide misspelt names from mypy
        return cls

    return register


def with_suggestions(function: Callable[P, T], name: str | None = None) -> Callable[P, T]:
    """Decorator: an unknown keyword is refused with the closest known keyword, or with the list of all keywords.

    A function with ``**kwargs`` is returned unchanged; the function that receives them checks them.
    """
    by_name = keywords(function)
    if by_name is None:
        return function

    @functools.wraps(function)
    def called(*arguments: P.args, **options: P.kwargs) -> T:
        refuse_misspelt(options, by_name, name or function.__name__)
        return function(*arguments, **options)

    return called


def front_door(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a public function: sets the package's JAX options and adds ``with_suggestions``.

    If ``solve`` or ``march`` raises inside the function, the message begins with the name of the outer function. Ctrl-C
    is a ``KeyboardInterrupt`` even if it came while a compiled program called the host, as under ``grad``.
    """

    @functools.wraps(function)
    def entered(*arguments: P.args, **options: P.kwargs) -> T:
        refuse_error_checks(function.__qualname__.removesuffix(".__init__"))
        with own_settings():
            try:
                return function(*arguments, **options)
            except (ValueError, TypeError, jax.errors.JaxRuntimeError) as error:
                if INTERRUPT.search(str(error)):
                    raise KeyboardInterrupt from error
                _rename(error, function.__name__)
                raise

    return with_suggestions(entered)


def _rename(refusal: Exception, caller: str) -> None:
    """Replace, in place, the function named at the start of an error message by the function the user called."""
    if refusal.args and isinstance(refusal.args[0], str):
        refusal.args = (INNER.sub(rf"\1{caller}: ", refusal.args[0], count=1), *refusal.args[1:])


def keywords(function: Callable) -> Set[str] | None:
    """The keywords of a function; None if it has ``**kwargs``."""
    parameters = inspect.signature(function).parameters.values()
    if any(each.kind is each.VAR_KEYWORD for each in parameters):
        return None
    return {each.name for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)}


def refuse_misspelt(words: Iterable[str], by_name: Set[str], function: str) -> None:
    """Refuse the first word that is not a keyword of a function, and suggest the closest keyword."""
    for word in words:
        if word in by_name:
            continue
        raise TypeError(f"{function}() got an unexpected keyword argument {word!r}: {cure_of(word, by_name)}")


def _compare_by_value(cls: type, names: tuple[str, ...]) -> None:
    """Make objects without leaves equal if their fields are equal; as static arguments they then do not recompile."""

    def key(self: Any) -> tuple[Any, ...]:
        return tuple(getattr(self, name) for name in names)

    def equal(self: Any, other: object) -> bool:
        return key(self) == key(other) if type(other) is cls else NotImplemented

    def number(self: Any) -> int:
        return hash((cls, key(self)))

    cls.__eq__, cls.__hash__ = equal, number  # type: ignore[method-assign, assignment]


def _default(field: dataclasses.Field) -> Callable[[], Any]:
    """A function that makes the default of a field, a new one each time because dictionaries are mutable."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory
    if field.default is dataclasses.MISSING:
        raise TypeError(f"{field.name}: a host field does not survive flattening and needs a default")
    return lambda: field.default


def is_traced(*trees: Any) -> bool:
    """True if any leaf of the trees is a tracer, so that its value is not known yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def known(number: Any) -> Any:
    """The number or array in NumPy unless it is traced, because JAX compiles a program for every operation."""
    return number if is_traced(number) else np.asarray(number)


def remembered(function: Callable[..., T]) -> Callable[..., T]:
    """Decorator that caches results by the first argument, a pytree, including its numbers.

    For properties that require tracing a user's function, which costs more than a small solve. The other arguments must
    be hashable. Calls with traced arguments and exceptions are not cached.
    """
    answers: dict[Any, T] = {}

    @functools.wraps(function)
    def ask(tree: Any, *arguments: Any, **options: Any) -> T:
        if is_traced(tree):
            return function(tree, *arguments, **options)
        leaves, structure = jax.tree.flatten(tree)
        key = (structure, tuple(map(_digest, leaves)), arguments, tuple(options.items()))
        if key not in answers:
            answers[key] = function(tree, *arguments, **options)
            if len(answers) > REMEMBERED:  # dictionaries keep the order of insertion, so the first is the oldest
                del answers[next(iter(answers))]
        return answers[key]

    return ask


def as_one_program(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator of a function of pytrees with tracers: one compiled program, and one more for its derivative.

    ``grad`` and ``vmap`` without ``jit`` compile and run operation by operation. Here only the tracers are arguments of
    the program. Known numbers, including known numbers in the result, are constants of the program.
    """

    @jax.jit
    def run(given: "_PartlyTraced") -> "_PartlyTraced":
        arguments, options = given.tree()
        return _PartlyTraced.of(function(*arguments, **options))

    @functools.wraps(function)
    def called(*arguments: P.args, **options: P.kwargs) -> T:
        return run(_PartlyTraced.of((arguments, options))).tree()

    return called


@jax.custom_jvp
def tie(tree: Any) -> Any:
    """The same tree behind one barrier, so that XLA does not hoist computations from a loop if one leaf varies.

    Tangents pass without a barrier: JAX 0.12 cannot transpose a barrier of linear and constant tangents together, and a
    ``jax.custom_jvp`` rule has both, since the tangent of a constant is an array of zeros there.
    """
    return jax.lax.optimization_barrier(tree)


@tie.defjvp
def _tie_tangent(primals: tuple, tangents: tuple) -> tuple:
    return tie(*primals), tangents[0]


@jax.tree_util.register_pytree_node_class
class _PartlyTraced:
    """A pytree whose leaves are the tracers of another tree; the known numbers belong to its structure."""

    def __init__(self, known: "_Known", traced: Iterable[Any]):
        self.known, self.traced = known, tuple(traced)

    @classmethod
    def of(cls, tree: Any) -> "_PartlyTraced":
        leaves, structure = jax.tree.flatten(tree)
        known = tuple(None if is_traced(leaf) else leaf for leaf in leaves)
        return cls(_Known(structure, known), filter(is_traced, leaves))

    def tree(self) -> Any:
        """The whole tree."""
        others = iter(self.traced)
        leaves = [next(others) if leaf is None else leaf for leaf in self.known.leaves]
        return jax.tree.unflatten(self.known.structure, leaves)

    def tree_flatten(self) -> tuple[tuple, "_Known"]:
        return self.traced, self.known

    @classmethod
    def tree_unflatten(cls, known: "_Known", traced: Iterable[Any]) -> "_PartlyTraced":
        return cls(known, traced)


class _Known:
    """The structure of a tree and some of its leaves; equal to another if the bits of the numbers are equal."""

    def __init__(self, structure: Any, leaves: tuple):
        self.structure, self.leaves = structure, leaves
        self.key = (structure, tuple(leaf if leaf is None else _digest(leaf) for leaf in leaves))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Known) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def _digest(leaf: Numbers) -> tuple[Any, ...]:
    """Type, shape, dtype and a digest of the bits of a leaf: equal for equal leaves."""
    array = np.ascontiguousarray(leaf)  # compare bits, because NaN is not equal to NaN
    return type(leaf), array.shape, array.dtype, hashlib.blake2b(array.tobytes(), digest_size=16).digest()


def numbers(value: object, name: str) -> Any:
    """A float64 copy of concrete numbers; tracers, and lists that contain one, stay traced."""
    # float64 for any JAX setting: a solve casts to its own dtype later, and grids compare corners before that
    if is_traced(value) and isinstance(value, (jax.core.Tracer, Sequence)):
        return jax.numpy.asarray(value)
    try:
        # NumPy would parse "1.0", drop imaginary parts, and count years since 1970
        if np.asarray(value).dtype.kind in "UScmM":
            raise TypeError
        return np.array(value, dtype=np.float64)  # a copy, so that later changes of the original have no effect
    except OverflowError:  # an integer beyond 1e308
        raise ValueError(f"{name}: got {value!r:.60}, wanted numbers that fit into float64") from None
    except (TypeError, ValueError):
        raise TypeError(f"{name}: got {shown(value)}, wanted numbers") from None


def as_partial(function: Callable | None, name: str = "function") -> jax.tree_util.Partial | None:
    """A callable as a pytree: a bound method of a registered dataclass has the fields of the dataclass as leaves.

    A callable that is itself a pytree, such as a registered dataclass with a ``__call__``, has its own leaves.
    """
    if function is None or isinstance(function, jax.tree_util.Partial):
        return function
    if not callable(function):
        raise TypeError(f"{name}: got {shown(function)}, wanted a function of one state")
    # the function of a Partial belongs to the structure, so use the function of the class, which is equal for all
    # objects, and pass the object as an argument; a bound method would recompile for every object
    if not jax.tree_util.all_leaves([function]):
        return jax.tree_util.Partial(type(function).__call__, function)
    owner = getattr(function, "__self__", None)
    if owner is not None and hasattr(function, "__func__") and not jax.tree_util.all_leaves([owner]):
        return jax.tree_util.Partial(function.__func__, owner)
    return jax.tree_util.Partial(function)


def altered(tree: T, **fields: Any) -> T:
    """A copy with changed fields and without the checks of ``dataclasses.replace``, which would fail on tracers.

    Cached properties are computed again, because they may depend on the changed fields.
    """
    result = copy.copy(tree)  # shallow, and without __init__
    owner: Any = type(tree)
    for name in _cached_properties(owner):
        vars(result).pop(name, None)
    for name, value in fields.items():
        object.__setattr__(result, name, value)
    return result


@functools.cache
def _cached_properties(cls: type) -> tuple[str, ...]:
    """The names of the cached properties of a class."""
    return tuple(name for name, member in vars(cls).items() if isinstance(member, functools.cached_property))


def as_jax(tree: T) -> T:
    """The tree with NumPy numbers as JAX arrays, in the widest type that JAX is set to.

    For arguments of a compiled function inside a trace: JAX 0.10 confuses a program that took NumPy float64 numbers in
    a 64-bit trace with a 32-bit program.
    """

    def convert(leaf: Any) -> Any:
        if not isinstance(leaf, (np.ndarray, np.generic)):
            return leaf
        # with an explicit type; otherwise JAX may return its cached copy of the array in the other precision
        return jax.numpy.asarray(leaf, jax.numpy.result_type(leaf))

    return jax.tree.map(convert, tree)


def in_type(tree: T, dtype: DType) -> T:
    """The tree with its NumPy arrays of floating-point numbers in ``dtype``; host level."""

    def convert(leaf: Any) -> Any:
        is_known = isinstance(leaf, np.ndarray) and np.issubdtype(leaf.dtype, np.floating)
        return leaf.astype(dtype) if is_known else leaf

    return jax.tree.map(convert, tree)


def cast(tree: T, dtype: DType) -> T:
    """The tree with its floating-point leaves in ``dtype``; integers and booleans are unchanged."""

    def convert(leaf: Any) -> Any:
        if not jax.numpy.issubdtype(jax.numpy.result_type(leaf), jax.numpy.floating):
            return leaf
        return jax.numpy.asarray(leaf, dtype)

    return jax.tree.map(convert, tree)
