"""Decorator for Numba functions, with a cache on disk that notices changed callees.

Numba keeps compiled code until the file of the function changes. It does not notice that a
function which is called, in another file, has changed. Here what is kept counts only while no
source that a compiled function may call has changed.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, overload

from numba import njit
from numba.core.caching import FunctionCache

F = TypeVar("F", bound=Callable[..., Any])

_NOT_CALLED = {"node", "nodes", "ros", "parameters", "cli", "tools", "__pycache__"}
"""Folders that compiled functions never call: the maths does not import them."""


@overload
def compiled(function: F) -> F: ...
@overload
def compiled(*, error_model: str) -> Callable[[F], F]: ...
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
    return dispatcher


class _SourceCache(FunctionCache):
    """Numba's cache of one function, which also looks at the sources around it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        file = self._cache_file
        # When this stamp differs from the one in the cache, Numba drops what is there.
        file._source_stamp = (file._source_stamp, _digest(function.__module__.partition(".")[0]))


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
