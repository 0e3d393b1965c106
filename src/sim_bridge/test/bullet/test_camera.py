# SPDX-License-Identifier: Apache-2.0
"""Pictures: what is where it should be, and the robot's own world stays as it is."""

from contextlib import closing

import numpy as np
import pytest

from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.tools.camera import Camera
from viability_bounds_pkg.robot.description import read_urdf
from viability_bounds_pkg.testing.ros_harness import read_config

CONFIG = read_config("panda", "bullet_node")
Q = np.array(CONFIG["start_positions"])
EYE, TARGET, SIZE = [1.5, -1.0, 0.6], [0.3, 0.0, 0.4], (96, 72)
RED = [0.9, 0.1, 0.1]


@pytest.fixture(scope="module")
def robot():
    urdf = read_urdf(CONFIG["robot_description"])
    with closing(BulletRobot(urdf, CONFIG["joints"], physics_dt=1e-3)) as robot:
        yield robot


@pytest.fixture(scope="module")
def camera(robot):
    with closing(Camera(robot, floor=0.0, colors={"ball": RED})) as camera:
        yield camera


def red(picture):
    """Return which pixels are red, shape (height, width)."""
    r, g, b = np.moveaxis(picture.astype(int), -1, 0)
    return (r > 100) & (r > 2 * g) & (r > 2 * b)


def pixel(point):
    """Return row and column where a point is to be seen: a pinhole camera, angle 40 degrees."""
    eye, target = np.array(EYE), np.array(TARGET)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    x, y, depth = np.array([right, np.cross(right, forward), forward]) @ (point - eye)
    scale = 0.5 * SIZE[1] / np.tan(np.radians(20.0)) / depth
    return 0.5 * SIZE[1] - scale * y, 0.5 * SIZE[0] + scale * x


def test_the_robot_and_its_obstacles_are_seen_where_they_are(robot, camera):
    robot.reset(Q, np.zeros(7))
    bare = camera.snapshot(EYE, TARGET, SIZE)
    assert bare.shape == (72, 96, 3) and bare.dtype == np.uint8
    place = np.array([0.7, 0.2, 0.5])
    robot.obstacles.add(Obstacle("ball", "sphere", [0.12] * 3, place))
    picture = camera.snapshot(EYE, TARGET, SIZE)
    seen = red(picture)
    assert not red(bare).any() and seen.sum() > 20
    np.testing.assert_allclose(np.argwhere(seen).mean(axis=0), pixel(place), atol=1.0)
    robot.obstacles.add(Obstacle("ball", "sphere", [0.12] * 3, place + [0.0, 0.3, 0.0]))
    moved = red(camera.snapshot(EYE, TARGET, SIZE))
    where = pixel(place + [0.0, 0.3, 0.0])
    np.testing.assert_allclose(np.argwhere(moved).mean(axis=0), where, atol=1.0)
    robot.obstacles.clear()
    np.testing.assert_array_equal(camera.snapshot(EYE, TARGET, SIZE), bare)
    # The hand: the picture changes there when it moves, and not at the foot.
    bent = camera.snapshot(EYE, TARGET, SIZE, q=Q + [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    differs = np.abs(bent.astype(int) - bare).max(axis=2) > 20
    row, column = np.round(pixel(robot.link_pose("panda_hand").translation)).astype(int)
    assert differs[row - 2 : row + 3, column - 2 : column + 3].any()
    row, column = np.round(pixel(np.array([0.0, 0.0, 0.1]))).astype(int)
    assert not differs[row - 2 : row + 3, column - 2 : column + 3].any()


def test_pictures_do_not_touch_the_robots_world(robot):
    states = []
    for seen in (False, True):
        robot.reset(Q, np.full(7, 0.2))
        robot.step(np.ones(7), 20)
        if seen:
            with closing(Camera(robot)) as camera:
                camera.snapshot(EYE, TARGET, (32, 24))
        robot.step(np.ones(7), 20)
        states.append(robot.state())
    np.testing.assert_array_equal(np.stack(states[0]), np.stack(states[1]))


def test_a_camera_that_cannot_be_is_refused(camera):
    with pytest.raises(ValueError, match="eye must be 3"):
        camera.snapshot([1.0, np.nan, 0.0], TARGET, SIZE)
    with pytest.raises(ValueError, match="q must be 7"):
        camera.snapshot(EYE, TARGET, SIZE, q=[0.0])
