# SPDX-License-Identifier: Apache-2.0
"""How far commands that come late, or never, take a joint from where it was expected."""

from collections import Counter, defaultdict
from itertools import product

import pytest

from viability_bounds_pkg.uncertainty import DeclaredUncertainty, wrong_periods


def acting_commands(delay, jitter, missed):
    """Yield which command acts in each period until command 0 begins to, in all cases.

    Command 0 answers the state of period 0 and should act in period `delay`.
    """
    oldest = delay + jitter + missed + 1
    cases = [*range(jitter + 1), None]
    for fates in product(cases, repeat=oldest):
        gone = "".join("x" if late is None else "." for late in fates)
        if "x" * (missed + 1) in gone:
            continue
        sent = zip(range(-oldest, 0), fates, strict=True)
        arrival = {k: k + delay + late for k, late in sent if late is not None}
        for last in range(jitter + 1):
            there = [
                [k for k, arrived in arrival.items() if arrived <= period]
                for period in range(delay + last)
            ]
            if all(there):
                yield [max(each) for each in there]


def wrong(acting, delay):
    """Return what commands between 0 and 1 that act instead of those expected do at most.

    In periods; and weighted by time: what the position is off in the middle of the period when
    command 0 should act, had command 0 acted from then on.
    """
    expected = [min(period - delay, 0) for period in range(len(acting))]
    weights = defaultdict(float)
    for period, pair in enumerate(zip(acting, expected, strict=True)):
        for command, sign in zip(pair, (1.0, -1.0), strict=True):
            weights[command] += sign * (delay - period - 0.5)
    position = max(sum(max(sign * w, 0.0) for w in weights.values()) for sign in (1.0, -1.0))
    return (Counter(acting) - Counter(expected)).total(), position


@pytest.mark.parametrize(
    ("delay", "jitter", "missed"),
    [(0, 1, 0), (1, 0, 1), (1, 1, 0), (2, 0, 1), (2, 1, 0), (3, 1, 0), (1, 1, 1), (2, 0, 2)]
    + [(0, 0, 2), (2, 0, 0), (0, 2, 0), (1, 2, 0)],
)
def test_no_order_of_commands_does_more_than_is_kept_back_for(delay, jitter, missed):
    declared = DeclaredUncertainty(delay=delay, delay_jitter=jitter, missed_deadlines=missed)
    found = [wrong(acting, delay) for acting in acting_commands(delay, jitter, missed)]
    velocity, position = map(max, zip(*found, strict=True))
    assert velocity == wrong_periods(declared)
    assert position <= 0.5 * (delay**2 + jitter**2) * (velocity > 0)
