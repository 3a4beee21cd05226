"""A type checker for jaxtyping that looks at annotations of arrays alone: types and axes, within each call."""

import functools
import inspect
import types
import typing

import jax
import jaxtyping
import numpy as np

SEEN: set[str] = set()  # functions with an annotation that was looked at


def widened(kind):
    """An array's class for NumPy's arrays as well, as which the states of a loop begin on the host."""
    if not issubclass(kind, jaxtyping.AbstractArray):
        return (kind,)
    return tuple(kind.dtype[each, kind.dim_str] for each in (jax.Array, np.ndarray))


def arrays_of(hint):
    """The classes of a hint, if one of them is an array with axes; else none."""
    union = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
    kinds = typing.get_args(hint) if union else (hint,)
    plain = all(isinstance(kind, type) and typing.get_origin(kind) is None for kind in kinds)
    named = plain and any(issubclass(kind, jaxtyping.AbstractArray) for kind in kinds)
    return tuple(each for kind in kinds for each in widened(kind)) if named else ()


def fits(value, kinds):
    """True if a value is of one of the classes; a number of NumPy's is an array without axes."""
    return isinstance(np.asarray(value) if isinstance(value, np.generic) else value, kinds)


def check(function):
    """The function with the arrays among its arguments and its result held against their annotations."""
    signature, hints = inspect.signature(function), None

    def resolved():
        found = {}
        for name, hint in function.__annotations__.items():
            if isinstance(hint, str):
                try:
                    hint = eval(hint, function.__globals__)
                except NameError:  # known to type checkers only
                    continue
            if kinds := arrays_of(hint):
                found[name] = kinds
        return found

    @functools.wraps(function)
    def checked(*arguments, **options):
        nonlocal hints
        hints = resolved() if hints is None else hints
        if hints:
            SEEN.add(f"{function.__module__}.{function.__qualname__}")
        for name, value in signature.bind(*arguments, **options).arguments.items():
            if name in hints and not fits(value, hints[name]):
                raise TypeError(f"{name}: got {value!r}, wanted {hints[name]}")
        result = function(*arguments, **options)
        if "return" in hints and not fits(result, hints["return"]):
            raise TypeError(f"{function.__qualname__} returned {result!r}, wanted {hints['return']}")
        return result

    return checked
