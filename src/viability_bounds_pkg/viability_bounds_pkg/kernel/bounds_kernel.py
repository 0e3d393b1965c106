"""The bounds of one joint state after the other, compiled.

One loop serves a single arm and a batch of a million states. The compiled code is cached beside
this file, so that only the first start on a machine pays for compiling.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.joint_limits import ROUNDING
from viability_bounds_pkg.kernel.braking import Side

Array = NDArray[np.float64]

_WITHIN = 1.0 + ROUNDING


class Table(NamedTuple):
    """The constants of n joints, as the kernel reads them.

    Attributes:
        ranges: shape (n, 3): q_min and q_max, rad, and the speed that still counts as viable.
        sides: shape (n, 2, 15), upper and lower limit: the numbers of `Side`, then of its landing
            the first node, the number of nodes, the period and the peak.
        budgets: the nodes' budgets of all landings, rad.
        speeds: their speeds, rad/s.
    """

    ranges: Array
    sides: Array
    budgets: Array
    speeds: Array


def make_table(joints: Sequence[tuple[float, float, float, Side, Side]]) -> Table:
    """Return the table of joints, each (q_min, q_max, viable speed, upper side, lower side)."""
    ranges = np.array([joint[:3] for joint in joints])
    budgets: list[float] = []
    speeds: list[float] = []
    rows = []
    for _, _, _, *sides in joints:
        for *numbers, landing in sides:
            nodes = [len(budgets), 0, 1.0, 0.0]
            if landing is not None:
                nodes = [len(budgets), len(landing.budget), landing.period, landing.peak]
                budgets += landing.budget
                speeds += landing.speed
            rows.append([*numbers, *nodes])
    sides = np.array(rows, dtype=float).reshape(len(joints), 2, -1)
    return Table(ranges, sides, np.array(budgets, dtype=float), np.array(speeds, dtype=float))


@compiled
def _landing_speed(budget, parabola, side, budgets, speeds):
    """Return the largest end-of-step speed w with ``dt w / 2 + U(w) <= budget``.

    `parabola` is the answer if the stopping curve U were the parabola.
    """
    first, count, period, peak = int(side[11]), int(side[12]), side[13], side[14]
    if count == 0 or parabola % period >= peak:
        return parabola
    low, high = first, first + count
    while low < high:
        middle = (low + high) // 2
        if budget < budgets[middle]:
            high = middle
        else:
            low = middle + 1
    if low == first + count:
        # Only from outside: so fast a joint would need more room than there is in the range. To
        # come to rest as a step ends it needs chords of the parabola, one for each step.
        length, per_step = budget / side[0], 2.0 * side[3]
        steps = floor(0.5 * (sqrt(1.0 + 8.0 * length / per_step) - 1.0))
        rest = length - 0.5 * per_step * steps * (steps + 1.0)
        return max(speeds[low - 1], per_step * steps + rest / (steps + 1.0))
    share = (budget - budgets[low - 1]) / (budgets[low] - budgets[low - 1])
    return speeds[low - 1] + (speeds[low] - speeds[low - 1]) * share


@compiled
def _bound_towards(room, v, side, budgets, speeds):
    """Return the largest acceleration towards a limit that keeps it, and whether it can be kept.

    Args:
        room: distance to the limit, rad; negative outside.
        v: velocity towards it, rad/s.
        side: the limit's row of `Table.sides`.
        budgets: `Table.budgets`.
        speeds: `Table.speeds`.

    Returns:
        Acceleration, rad/s^2, within those of the side whatever the state; and whether the
        joint is inside the position limit and can stop before it.
    """
    dt, half_dt, twice_braking, k, k2 = side[0], side[1], side[2], side[3], side[4]
    far, v_max, low, high = side[5], side[6], side[7], side[8]
    margin, tolerance, count = side[9], side[10], side[12]
    # Room that is left if the step ends at rest.
    budget = room - half_dt * v
    if budget >= far:
        a = (v_max - v) / dt
    elif budget >= 0.0:
        c = twice_braking * budget
        w = c / (k + sqrt(k2 + c))
        w = _landing_speed(budget, w, side, budgets, speeds)
        a = (min(w, v_max) - v) / dt
    elif v > 0.0:
        # Stop within the step: eq. (19). Outside, and still leaving: brake.
        a = -v * (v / (2.0 * room)) if room > 0.0 else low
    else:
        # Outside and on the way back: be on the limit when the step ends.
        a = (2.0 * budget / dt - v) / dt
    a -= margin
    # Written so that a NaN becomes `high`.
    if not a < high:
        a = high
    elif a < low:
        a = low
    room += tolerance
    if v <= 0.0:
        return a, room >= 0.0
    viable = v * v <= twice_braking * room
    if viable and count > 0.0:
        budget = min(room + half_dt * v, far)
        c = twice_braking * budget
        parabola = c / (k + sqrt(k2 + c))
        viable = v <= _landing_speed(budget, parabola, side, budgets, speeds) * _WITHIN
    return a, viable


@compiled
def _settle(above, below, v, lower, upper, side):
    """Return the one acceleration left where the two limits contradict each other.

    That happens outside the kernel, or by rounding on its edge. The limit that is still kept
    is not given up for the one that is broken: a joint on its way back keeps its speed limit,
    and one that cannot stop in time stops as soon as it can without being thrown against the
    other limit. The broken one is told by the position or, inside, by the direction of motion.
    Neither is worth a speed beyond its limit; `side` is the row of the upper one.
    """
    if above < 0.0 or (below >= 0.0 and v > 0.0):
        a = lower
    elif below < 0.0 or v < 0.0:
        a = upper
    else:
        a = 0.5 * (lower + upper)
    dt, v_max, a_min, a_max, margin = side[0], side[6], side[7], side[8], side[9]
    a = max(min(a, (v_max - v) / dt - margin), (-v_max - v) / dt + margin)
    return max(min(a, a_max), a_min)


@compiled(error_model="numpy")
def solve(q, v, ranges, sides, budgets, speeds, lower, upper, viable):
    """Fill in the bounds of m states of n joints.

    Args:
        q: shape (m, n), rad.
        v: shape (m, n), rad/s.
        ranges: of `Table`, as are the three that follow.
        sides: see `Table`.
        budgets: see `Table`.
        speeds: see `Table`.
        lower: shape (m, n), receives the lower bounds, rad/s^2.
        upper: shape (m, n), receives the upper bounds, rad/s^2.
        viable: shape (m, n), bool, receives whether the state is in the kernel.
    """
    m, n = q.shape
    for i in range(m):
        for j in range(n):
            speed = v[i, j]
            above, below = ranges[j, 1] - q[i, j], q[i, j] - ranges[j, 0]
            high, keeps_high = _bound_towards(above, speed, sides[j, 0], budgets, speeds)
            low, keeps_low = _bound_towards(below, -speed, sides[j, 1], budgets, speeds)
            low = -low
            if low > high:
                low = high = _settle(above, below, speed, low, high, sides[j, 0])
            lower[i, j] = low
            upper[i, j] = high
            viable[i, j] = keeps_high and keeps_low and abs(speed) <= ranges[j, 2]
