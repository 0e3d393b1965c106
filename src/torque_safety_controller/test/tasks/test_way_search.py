# SPDX-License-Identifier: Apache-2.0
"""Ways round what cannot be passed, in the plane."""

import numpy as np
import pytest
from searches import finished

from torque_safety_controller.tasks.way_search import STEP, find_way

LOW, HIGH = np.full(2, -2.0), np.full(2, 2.0)
TRIES = 500
START, GOAL = np.array([-1.0, 0.0]), np.array([1.0, 0.1])


def search(can_pass, seed=0, goal=GOAL):
    return finished(find_way(START, goal, LOW, HIGH, can_pass, np.random.default_rng(seed), TRIES))


def wall(q):
    """A wall between start and goal, of 0.4 rad, with a way round it on one side."""
    return not (abs(q[0]) < 0.2 and q[1] < 1.2)


def test_the_straight_way_is_taken_where_it_can_be():
    way, cost = search(lambda q: True)
    assert len(way) == 2
    assert way[0] is START
    assert way[1] is GOAL
    assert cost <= np.ceil(2.0 / STEP) + 1


@pytest.mark.parametrize("seed", range(10))
def test_a_way_round_is_found_and_can_be_passed(seed):
    way, _ = search(wall, seed)
    assert way[0] is START
    assert way[-1] is GOAL
    for a, b in zip(way, way[1:], strict=False):
        apart = np.abs(b - a).max()
        # Between the postures that were looked at there may be up to STEP.
        inside = [q for s in np.linspace(0.0, 1.0, 200) if not wall(q := a + s * (b - a))]
        assert apart * len(inside) / 200 < STEP
    # The shortest way round the wall has 3.1 rad.
    assert sum(np.linalg.norm(b - a) for a, b in zip(way, way[1:], strict=False)) < 4.5


def test_there_is_none_through_a_closed_wall():
    assert search(lambda q: abs(q[0]) >= 0.2)[0] is None


def test_the_same_seed_gives_the_same_way():
    np.testing.assert_array_equal(search(wall, 3)[0], search(wall, 3)[0])


def test_a_goal_where_the_arm_is_is_a_way():
    way, cost = search(lambda q: True, goal=START.copy())
    assert len(way) == 2
    assert cost <= 2
