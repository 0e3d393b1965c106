# SPDX-License-Identifier: Apache-2.0
"""What became of fuzzed messages and files, counted; and the error of a claim that is broken."""

from __future__ import annotations

from collections import Counter

TAKEN = "taken"


class ClaimBroken(AssertionError):
    """A claim of docs/safety.md did not hold."""


class Tally:
    """Counts by kind and outcome.

    Attributes:
        sent: how many of each kind.
        outcomes: how many of each kind came to what, for each node that heard them.
        facts: what else was counted.
    """

    def __init__(self) -> None:
        self.sent: Counter[str] = Counter()
        self.outcomes: Counter[tuple[str, str]] = Counter()
        self.facts: Counter[str] = Counter()

    def add(self, other: Tally) -> None:
        """Add the counts of another one."""
        self.sent += other.sent
        self.outcomes += other.outcomes
        self.facts += other.facts

    def table(self) -> str:
        """Return a line for each kind: how many, how many taken, and the others by outcome."""
        lines = []
        for kind, count in sorted(self.sent.items()):
            found = {what: n for (of, what), n in self.outcomes.items() if of == kind}
            taken = found.pop(TAKEN, 0)
            rest = ", ".join(
                f"{n} {what}" for what, n in sorted(found.items(), key=lambda e: -e[1])
            )
            lines.append(f"{kind:32} {count:8} {taken:8}  {rest}")
        return "\n".join([f"{'kind':32} {'sent':>8} {TAKEN:>8}  else", *lines])
