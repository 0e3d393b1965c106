# SPDX-License-Identifier: Apache-2.0
"""Odd messages and odd files for the real nodes: the big run, and parts of it played again."""

from __future__ import annotations

import argparse
import faulthandler
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from fuzzing import files, messages
from fuzzing.messages import Failure
from fuzzing.tally import Tally

OUT = Path("results/fuzz")
PARTS: dict[str, Any] = {"messages": messages, "files": files}


def main(arguments: list[str] | None = None) -> int:
    """Run; return 0 where nothing broke."""
    parser = argparse.ArgumentParser(prog="fuzz.py", description=(__doc__ or "").strip())
    add = parser.add_argument
    add("--messages", type=int, default=0, metavar="N", help="how many odd messages")
    add("--files", type=int, default=0, metavar="N", help="how many odd files")
    add("--seed", type=int, default=1, help="of the first part (default: %(default)s)")
    add("--out", type=Path, default=OUT, metavar="DIRECTORY", help="of cases that broke")
    add("--replay", type=Path, metavar="FILE", help="play a case again that broke")
    options = parser.parse_args(arguments)
    show = _quiet()
    if options.replay:
        kind, number, case = options.replay.read_text().split()[:3]
        failure = PARTS[kind].play(int(number), Tally(), case=case.encode())
        show(f"{failure.text}\n{failure.kind}\n" if failure else "nothing broke\n")
        return 1 if failure else 0
    if not options.messages and not options.files:
        parser.error("say how many: --messages N, --files N")
    broken = 0
    for kind, count in (("messages", options.messages), ("files", options.files)):
        if count:
            broken += _run(kind, count, options.seed, options.out, show)
    return 1 if broken else 0


def _run(kind: str, count: int, seed: int, out: Path, show: Callable[[str], None]) -> int:
    """Run one kind; return how many parts broke."""
    tally, began, cpu = Tally(), time.monotonic(), time.process_time()

    def keep(failure: Failure) -> None:
        out.mkdir(parents=True, exist_ok=True)
        path = out / f"{kind}_{failure.seed}.txt"
        path.write_text(f"{kind} {failure.seed} {failure.case}\n\n{failure.text}")
        show(f"\n{failure.kind}\n  again: bash scripts/fuzz.sh --replay {path}\n")

    failures = PARTS[kind].fuzz(count, seed, tally, show, keep)
    show(f"\n\n{tally.table()}\n\n")
    for what, number in sorted(tally.facts.items()):
        show(f"{number:9} {what}\n")
    show(
        f"\n{kind}: {sum(tally.sent.values())} in {time.monotonic() - began:.0f} s, "
        f"{time.process_time() - cpu:.0f} s of the processor; "
        f"{sum(not each.claim for each in failures)} crashes, "
        f"{sum(each.claim for each in failures)} claims broken\n"
    )
    return len(failures)


def _quiet() -> Callable[[str], None]:
    """Let the nodes' log go nowhere; return what writes to the screen."""
    screen = os.fdopen(os.dup(1), "w", encoding="utf-8", errors="replace")
    faulthandler.enable(file=screen)
    nothing = os.open(os.devnull, os.O_WRONLY)
    sys.stderr.flush()
    os.dup2(nothing, 2)

    def show(text: str) -> None:
        screen.write(text)
        screen.flush()

    return show


if __name__ == "__main__":
    sys.exit(main())
