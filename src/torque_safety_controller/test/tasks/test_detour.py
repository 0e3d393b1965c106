# SPDX-License-Identifier: Apache-2.0
"""When a detour begins and ends, and which joint goes first."""

import numpy as np
import pytest

from torque_safety_controller.tasks.detour import LONGEST, OTHERS, PATIENCE, Detour
from torque_safety_controller.tasks.posture_task import PostureTask

DT = 0.01
GOAL = np.array([1.0, 1.0, 1.0])
HERE = np.array([0.0, 0.5, 1.0])
REST = np.zeros(3)
LOAD = np.array([0.2, 0.95, 0.3])
PATIENT = round(PATIENCE / DT)


def stand(detour, steps, q=HERE, v=REST, load=LOAD, goal=GOAL, held=True):
    for _ in range(steps):
        shares = detour.shares(goal, q, v, load, lambda q: held)
    return shares


def test_the_joint_that_holds_most_goes_first_after_a_while():
    detour = Detour(DT)
    assert stand(detour, PATIENT) is None
    np.testing.assert_array_equal(stand(detour, 2), [OTHERS, 1.0, OTHERS])
    assert detour.joint == 1


def test_the_joint_that_is_farthest_off_where_that_one_has_arrived():
    detour = Detour(DT)
    stand(detour, PATIENT + 2, q=np.array([0.0, 1.0, 0.9]))
    assert detour.joint == 0


@pytest.mark.parametrize(
    "other",
    [
        {"v": np.array([0.0, 0.0, 0.1])},
        {"q": GOAL - 0.01},
        {"load": 0.5 * LOAD},
        {"held": False},
    ],
)
def test_there_is_none_while_the_arm_moves_or_has_arrived_or_may_go_on(other):
    detour = Detour(DT)
    assert stand(detour, 10 * PATIENT, **other) is None


def test_it_has_to_stand_without_a_break():
    detour = Detour(DT)
    stand(detour, PATIENT)
    stand(detour, 1, v=np.array([0.0, 0.0, 0.1]))
    assert stand(detour, PATIENT) is None


def test_it_ends_when_the_joint_arrives_or_takes_too_long_or_the_goal_changes():
    for steps, other in (
        (1, {"q": np.array([0.0, 0.99, 1.0])}),
        (round(LONGEST / DT) + 2, {}),
        (1, {"goal": GOAL.copy()}),
    ):
        detour = Detour(DT)
        stand(detour, PATIENT + 2)
        assert detour.joint == 1
        assert stand(detour, steps, **other) is None
        assert detour.joint is None


def test_shares_weigh_the_errors_of_a_posture_task():
    class Robot:
        q, v = HERE, REST

    shares = np.array([0.5, 1.0, 0.1])
    A, b, weight = PostureTask(GOAL, 10.0, 2.0, 3.0, shares=shares).term(Robot)
    a = np.array([1.0, -2.0, 3.0])
    expected = shares * (a - 10.0 * (GOAL - HERE))
    np.testing.assert_allclose(A @ a - b, expected)
    assert weight == 3.0
