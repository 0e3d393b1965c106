# SPDX-License-Identifier: Apache-2.0
"""Decorator for Numba functions, with a cache on disk that notices changed callees.

Numba keeps compiled code until the file of the function changes. It does not notice that a
function which is called, in another file, has changed. Here what is kept counts only while no
source that a compiled function may call has changed.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast, overload

from numba import njit, typeof, types
from numba.core.caching import FunctionCache, IndexDataCacheFile

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

_functions: list[Any] = []

_NOT_CALLED = {
    *("node", "nodes", "ros", "parameters", "cli", "tools", "testing", "user_input"),
    "__pycache__",
}
"""Folders that compiled functions never call: the maths does not import them."""


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
    dispatcher = njit(**options)(function)
    dispatcher._cache = _SourceCache(function)
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


class _SourceCache(FunctionCache):
    """Numba's cache of one function, which also looks at the sources around it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        own = self._impl.locator.get_source_stamp()
        # When this stamp differs from the one in the cache, Numba drops what is there.
        stamp = own, _digest(function.__module__.partition(".")[0])
        self._cache_file = _LockedFile(self._cache_path, self._impl.filename_base, stamp)


class _LockedFile(IndexDataCacheFile):
    """The files of one function, which one process at a time writes.

    Numba's own may mix up the code of two processes that compile the same function at the same
    time, and keep an index of old code when the process ends between two writes.
    """

    def load(self, key: Any) -> Any:
        if not Path(self._index_path).exists():
            return None
        with self._lock(write=False):
            try:
                return super().load(key)
            except Exception:  # damaged, by a power cut for example: compile again
                return None

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # as above
            return {}

    def save(self, key: Any, data: Any) -> None:
        with self._lock(write=True):
            overloads = self._load_index()
            if not overloads:
                self.flush()  # an index of older sources names files that are now overwritten
            taken = set(overloads.values())
            unused = (
                name for i in itertools.count(1) if (name := self._data_name(i)) not in taken
            )
            name = overloads.setdefault(key, next(unused))
            self._save_data(name, data)
            self._save_index(overloads)

    @contextmanager
    def _lock(self, *, write: bool) -> Iterator[None]:
        with open(Path(self._cache_path, ".compiled.lock"), "ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX if write else fcntl.LOCK_SH)
            yield


@functools.cache
def _digest(package: str) -> str:
    """Return a digest of the sources that compiled functions of a package may call."""
    digest = hashlib.sha256()
    for root in sorted({Path(__file__).parent, _folder(package)}):
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root).parts
            if _NOT_CALLED.isdisjoint(parts):
                digest.update("/".join(parts).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return Path(__file__).parent  # a function typed in by hand, or in a script
    return Path(spec.submodule_search_locations[0])
