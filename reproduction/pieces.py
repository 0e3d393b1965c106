# SPDX-License-Identifier: Apache-2.0
"""Long runs in pieces, on all cores; what is done is kept, so that they can be interrupted."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from chain import ROOT
from figure import RESULTS

Work = Callable[..., dict[str, Any]]


def sources() -> str:
    """Return a hash of all source files and parameters: results of other ones do not count."""
    found = hashlib.sha256()
    for folder, kind in (("src", "*.py"), ("config", "*.yaml"), ("reproduction", "*.py")):
        for path in sorted((ROOT / folder).rglob(kind)):
            if "test" not in path.relative_to(ROOT).parts:
                found.update(path.read_bytes())
    return found.hexdigest()


def in_pieces(
    name: str, work: Work, pieces: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], dict[str, Any]]]:
    """Do all pieces of work, those that are kept excepted; yield each with its result, in order.

    Args:
        name: folder under results/ that the results are kept in.
        work: called with a piece; its result must be what JSON can hold.
        pieces: arguments of `work`, each what JSON can hold.
    """
    now, folder = sources(), RESULTS / name / "pieces"
    folder.mkdir(parents=True, exist_ok=True)
    places = [_place(folder, piece) for piece in pieces]
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        futures = [
            None if _read(place, now) is not None else pool.submit(_do, work, piece, place, now)
            for piece, place in zip(pieces, places, strict=True)
        ]
        for piece, place, future in zip(pieces, places, futures, strict=True):
            if future is not None:
                future.result()
            result = _read(place, now)
            assert result is not None
            yield piece, result


def _do(work: Work, piece: tuple[Any, ...], place: Path, now: str) -> None:
    """Do a piece of work and keep its result."""
    text = json.dumps({"sources": now, "piece": piece, "result": work(*piece)})
    draft = place.with_suffix(".draft")
    draft.write_text(text)
    draft.replace(place)


def _place(folder: Path, piece: tuple[Any, ...]) -> Path:
    name = hashlib.sha256(json.dumps(piece).encode()).hexdigest()[:16]
    return folder / f"{name}.json"


def _read(place: Path, now: str) -> dict[str, Any] | None:
    """Return what is kept, or None if there is nothing that counts."""
    if not place.exists():
        return None
    kept = json.loads(place.read_text())
    return kept["result"] if kept["sources"] == now else None
