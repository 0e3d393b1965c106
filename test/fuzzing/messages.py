# SPDX-License-Identifier: Apache-2.0
"""The big run of odd messages: examples of the state machine, until enough were sent."""

from __future__ import annotations

import gc
import re
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import hypothesis
from fuzzing.edit import exploring
from fuzzing.machine import Machine
from fuzzing.tally import ClaimBroken, Tally
from hypothesis import reproduce_failure, seed
from hypothesis.errors import DidNotReproduce
from hypothesis.stateful import run_state_machine_as_test

EXAMPLES = 10
"""In a part of the run, which has a seed of its own and can be played again."""
STEPS = 50


class Failure(NamedTuple):
    """A part of a run in which something broke."""

    seed: int
    kind: str
    """Its error in a line, and where."""
    text: str
    """All that hypothesis says of it."""
    claim: bool
    """Whether it is a claim that did not hold, not a crash."""
    case: str
    """The example, as hypothesis writes it down."""


Show = Callable[[str], None]
Keep = Callable[[Failure], None]


def play(number: int, tally: Tally, *, case: bytes | None = None) -> Failure | None:
    """Play one part of a run; return what broke.

    Args:
        number: seed of this part.
        tally: counts what became of its messages.
        case: the only one to play, as a failure has it; None for all.
    """
    machine = seed(number)(type("Machine", (Machine,), {"tally": tally}))
    if case is not None:
        machine = reproduce_failure(hypothesis.__version__, case)(machine)
    settings = exploring(EXAMPLES, stateful_step_count=STEPS)
    return broken(number, partial(run_state_machine_as_test, machine, settings=settings))


def broken(number: int, part: Callable[[], object]) -> Failure | None:
    """Run a part; return what broke in it."""
    try:
        part()
    except DidNotReproduce:
        return None
    except Exception as error:
        failure = failed(number, error)
    else:
        return None
    gc.collect()  # nodes that the error left
    return failure


def failed(number: int, error: BaseException) -> Failure:
    """Return what broke in a part."""
    text = "".join(traceback.format_exception(error))
    found = re.search(r"@reproduce_failure\([^,]+, b'([^']+)'\)", text)
    case = found[1] if found else ""
    return Failure(number, described(error), text, isinstance(error, ClaimBroken), case)


def described(error: BaseException) -> str:
    """Return an error in a line, with the place in this project where it arose."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [each for each in frames if "hypothesis" not in each.filename]
    place = f"{ours[-1].filename.rpartition('/')[2]}:{ours[-1].lineno}" if ours else "?"
    text = " ".join(str(error).split())
    return f"{type(error).__name__} at {place}: {text[:300]}"


def fuzz(count: int, first: int, tally: Tally, show: Show, keep: Keep) -> list[Failure]:
    """Send that many odd messages; return what broke.

    Args:
        count: of messages.
        first: seed of the first part.
        tally: counts.
        show: shows a line on the progress.
        keep: is given what broke, at once.
    """
    failures: list[Failure] = []
    begin, number = time.monotonic(), first
    while (sent := _messages(tally)) < count:
        part = Tally()
        if failure := play(number, part):
            failures.append(failure)
            keep(failure)
        tally.add(part)
        number += 1
        rate = (time.monotonic() - begin) / max(1, _messages(tally))
        show(
            f"\rpart {number}, messages: {_messages(tally)} of {count}, {1e3 * rate:.1f} ms each, "
            f"{len(failures)} parts broke "
        )
        if sent == _messages(tally) and failures:
            break  # nothing gets through any more
    return failures


def _messages(tally: Tally) -> int:
    return sum(count for kind, count in tally.sent.items() if not kind.startswith("parameter"))
