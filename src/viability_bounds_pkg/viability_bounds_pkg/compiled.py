# SPDX-License-Identifier: Apache-2.0
"""Decorator for Numba functions whose code is kept on disk.

Numba keeps compiled code until the file of the function changes. It does not notice that a
function which is called, in another file, has changed: those that call each other share a file.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast, overload

from numba import njit, typeof, types

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

_functions: list[Any] = []


@overload
def compiled(function: F) -> F: ...
@overload
def compiled(**options: Any) -> Callable[[F], F]: ...
def compiled(function: Any = None, **options: Any) -> Any:
    """Compile a function at its first call with Numba, and keep the result for later processes.

    Args:
        function: to be compiled; None when options are given.
        options: of `numba.njit`.
    """
    if function is None:
        return functools.partial(compiled, **options)
    dispatcher = njit(cache=True, **options)(function)
    _functions.append(dispatcher)
    return dispatcher


def compiled_functions() -> tuple[Any, ...]:
    """Return every compiled function of the modules imported so far."""
    return tuple(_functions)


def is_kept(function: Any) -> bool:
    """Return whether code of a compiled function is kept that was made of the present sources."""
    return bool(function._cache._cache_file._load_index())


def compilations() -> int:
    """Return how often this process had to compile a function, because nothing was kept."""
    return sum(sum(function.stats.cache_misses.values()) for function in _functions)


def bound(function: Callable[..., T], *arguments: Any, numbers: int = 0) -> Callable[..., T]:
    """Return a compiled function with its first arguments fixed, compiled for their types.

    Numba looks up the types of all arguments at every call: microseconds, where there are many or
    where they are named tuples. Here it does so once.

    Args:
        function: of `compiled`.
        arguments: passed at every call; arrays among them are read and written in place.
        numbers: how many floats follow at the call.
    """
    signature = (*map(typeof, arguments), *[types.float64] * numbers)
    return functools.partial(cast(Any, function).compile(signature), *arguments)
