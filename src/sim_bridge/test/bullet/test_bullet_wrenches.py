# SPDX-License-Identifier: Apache-2.0
"""Wrenches on links: added up, held until cleared, none on the base."""

from contextlib import closing

import numpy as np
import pytest
from bullet_pairs import (
    CASES,
    PHYSICS_DT,
    Pair,
    single_robot,
)


def test_wrenches_on_two_links_add_up():
    with closing(Pair(CASES["panda"]).robot) as robot:
        velocities = []
        for pushes in ((True, False), (False, True), (True, True), (False, False)):
            robot.clear_wrenches()
            robot.reset(np.full(7, 0.4), np.zeros(7))
            if pushes[0]:
                robot.apply_wrench("panda_hand_tcp", [9.0, 9.0, 9.0], [9.0, 9.0, 9.0])  # replaced
                robot.apply_wrench("panda_hand_tcp", [10.0, 0.0, 5.0], [0.0, 1.0, 0.0])
            if pushes[1]:
                robot.apply_wrench("panda_link3", [0.0, -20.0, 0.0], [0.0, 0.0, 2.0])
            robot.step(np.zeros(7))
            velocities.append(robot.state().v)
        first, second, both, neither = velocities
        np.testing.assert_allclose(both - neither, first + second - 2 * neither, atol=1e-14)
        assert np.abs(first - neither).max() > 1e-4
        assert np.abs(second - neither).max() > 1e-4


def test_a_push_without_measure_is_over_after_a_reset():
    case = CASES["panda"]
    with closing(Pair(case).robot) as robot:
        q, limits = np.full(7, 0.4), np.full(7, 100.0)
        motions = []
        for force in (0.0, 1e308):
            robot.apply_wrench("panda_hand_tcp", [force] * 3, [force] * 3)
            robot.brake(3, limits)
            assert robot.finite == (force == 0.0)
            robot.clear_wrenches()
            robot.reset(q, np.zeros(7))
            robot.brake(20, limits)
            motions.append(robot.state().q - q)
        np.testing.assert_array_equal(*motions)


def test_wrench_is_held_in_world_axes_until_cleared():
    with single_robot() as robot:
        robot.apply_wrench("arm", [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        robot.step([0.0], 5)
        robot.step([0.0], 5)
        assert robot.state().v[0] == pytest.approx(10 * PHYSICS_DT * 1.0 / 0.5, rel=1e-12)
        robot.reset([1.0], [0.0])
        robot.step([0.0])
        assert robot.state().v[0] > 0.0  # a reset does not end the push
        robot.clear_wrenches()
        before = robot.state().v[0]
        robot.step([0.0], 5)
        assert robot.state().v[0] == before


def test_wrench_on_the_base_has_no_effect():
    with closing(Pair(CASES["baxter"]).robot) as robot:
        velocities = []
        for link in ("left_gripper", "right_gripper"):
            robot.clear_wrenches()
            robot.reset(np.zeros(7), np.zeros(7))
            robot.apply_wrench(link, [50.0, 0.0, 0.0], [0.0, 5.0, 0.0])
            robot.step(np.zeros(7))
            velocities.append(robot.state().v)
        robot.clear_wrenches()
        robot.reset(np.zeros(7), np.zeros(7))
        robot.step(np.zeros(7))
        np.testing.assert_array_equal(velocities[1], robot.state().v)
        assert np.abs(velocities[0] - velocities[1]).max() > 1e-3
