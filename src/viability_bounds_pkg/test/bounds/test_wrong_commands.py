# SPDX-License-Identifier: Apache-2.0
"""How far commands that come late, or never, take a joint from where it was expected."""

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
        for last in range(jitter + 1):
            arrival = {-oldest + i: fate for i, fate in enumerate(fates) if fate is not None}
            acting = []
            for period in range(delay + last):
                there = [k for k, late in arrival.items() if k + delay + late <= period]
                if not there:
                    break
                acting.append(max(there))
            else:
                yield acting


def counts(acting, delay):
    """Return how often each command acts more than expected, in all and weighted by time.

    The latter is what the position is off in the middle of the period when command 0 should act,
    had command 0 acted from then on.
    """
    velocity, position = {}, {}
    for period, command in enumerate(acting):
        expected = min(period - delay, 0)
        for each, sign in ((command, 1.0), (expected, -1.0)):
            velocity[each] = velocity.get(each, 0.0) + sign
            position[each] = position.get(each, 0.0) + sign * (delay - period - 0.5)
    return velocity, position


def most(weights):
    """Return the largest sum that commands between 0 and 1 make."""
    return max(sum(max(sign * w, 0.0) for w in weights.values()) for sign in (1.0, -1.0))


@pytest.mark.parametrize(
    ("delay", "jitter", "missed"),
    [(0, 1, 0), (1, 0, 1), (1, 1, 0), (2, 0, 1), (2, 1, 0), (3, 1, 0), (1, 1, 1), (2, 0, 2)]
    + [(0, 0, 2), (2, 0, 0), (0, 2, 0), (1, 2, 0)],
)
def test_no_order_of_commands_does_more_than_is_kept_back_for(delay, jitter, missed):
    declared = DeclaredUncertainty(delay=delay, delay_jitter=jitter, missed_deadlines=missed)
    weights = [counts(acting, delay) for acting in acting_commands(delay, jitter, missed)]
    velocity = max(most(v) for v, _ in weights)
    position = max(most(p) for _, p in weights)
    assert velocity == wrong_periods(declared)
    assert position <= 0.5 * (delay**2 + jitter**2) * (velocity > 0.0)
