# SPDX-License-Identifier: Apache-2.0
"""Robots that cannot be: the error names what is wrong."""

from contextlib import closing

import numpy as np
import pytest
from simulated_robots import H, single_joint_urdf

from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.files import RobotDescriptionError, read_urdf

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
ARM = [f"panda_joint{i}" for i in range(1, 8)]
SINGLE = single_joint_urdf()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"joints": ARM[::-1]}, "from base to tip"),
        ({"locked_positions": {"panda_joint2": 0.1}}, "both moved and locked"),
        ({"locked_positions": {"panda_finger_joint1": np.nan}}, "cannot be locked at nan"),
        ({"mass_scales": {"panda_link4": 0.0}}, "'panda_link4' cannot be scaled by 0"),
        ({"sensor_frame": "wing"}, "unknown link 'wing'"),
    ],
)
def test_joints_and_links_that_cannot_be(change, match):
    with pytest.raises(RobotDescriptionError, match=match):
        BulletRobot(read_urdf(PANDA), **{"joints": ARM, "physics_dt": H} | change)


@pytest.mark.parametrize(
    ("urdf", "match"),
    [
        ("<robot", "not well-formed"),
        (SINGLE.replace('parent link="base"', 'parent link="bas"'), "does not load"),
        (SINGLE.replace("</robot>", '<link name="lost"/></robot>'), "does not load"),
        (SINGLE.replace('xyz="0 0 1"', 'xyz="0 0 0"'), "without a direction"),
        (SINGLE.replace('ixx="0.5"', 'ixx="-0.5"'), "link 'arm'.*positive"),
    ],
)
def test_urdfs_that_cannot_be(urdf, match):
    with pytest.raises(RobotDescriptionError, match=match):
        BulletRobot(urdf, ["joint"], physics_dt=H)


def test_a_robot_without_its_shapes_moves_but_meets_no_obstacles():
    mesh = '<collision><geometry><mesh filename="package://no/such.stl"/></geometry></collision>'
    urdf = SINGLE.replace("</inertial>", f"</inertial>{mesh}")
    with closing(BulletRobot(urdf, ["joint"], physics_dt=H)) as robot:
        robot.step([1.0])
        with pytest.raises(RobotDescriptionError, match=r"no/such\.stl"):
            robot.obstacles.add(Obstacle("table", "box", [1.0] * 3, [0.0, 0.0, -1.0]))
