# SPDX-License-Identifier: Apache-2.0
"""What a robot is made of and told: joints, URDFs, arguments."""

import numpy as np
import pytest
from bullet_pairs import (
    PANDA,
    PANDA_ARM,
    PHYSICS_DT,
    single_joint,
    single_robot,
)

from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    read_urdf,
)


@pytest.mark.parametrize(
    ("joints", "locked", "match"),
    [
        (["nonsense"], {}, "unknown joint 'nonsense'.*panda_joint1"),
        (PANDA_ARM, {"nonsense": 0.0}, "unknown joint 'nonsense'"),
        (["panda_joint8"], {}, "unknown joint 'panda_joint8'"),
        (["panda_joint1", "panda_joint1"], {}, "once each"),
        (PANDA_ARM[::-1], {}, "from base to tip"),
        (PANDA_ARM, {"panda_joint2": 0.1}, "both moved and locked"),
        (PANDA_ARM, {"panda_finger_joint1": np.nan}, "cannot be locked at nan"),
    ],
)
def test_bad_joints_are_refused(joints, locked, match):
    with pytest.raises(RobotDescriptionError, match=match):
        BulletRobot(read_urdf(PANDA), joints, locked_positions=locked, physics_dt=PHYSICS_DT)


@pytest.mark.parametrize(
    ("urdf", "match"),
    [
        ("<robot", "not well-formed"),
        (single_joint().replace('parent link="base"', 'parent link="bas"'), "does not load"),
        (single_joint().replace("</robot>", '<link name="lost"/></robot>'), "does not load"),
        (single_joint().replace('xyz="0 0 1"', 'xyz="0 0 0"'), "without a direction"),
        (single_joint().replace('xyz="0 0 1"', 'xyz="0 1"'), "does not load"),
        (single_joint().replace('ixx="0.5"', 'ixx="-0.5"'), "link 'arm'.*positive"),
    ],
)
def test_bad_urdfs_are_refused(urdf, match):
    with pytest.raises(RobotDescriptionError, match=match):
        BulletRobot(urdf, ["joint"], physics_dt=PHYSICS_DT)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="physics_dt"):
        BulletRobot(single_joint(), ["joint"], physics_dt=0.0)
    with pytest.raises(ValueError, match="gravity"):
        BulletRobot(single_joint(), ["joint"], physics_dt=PHYSICS_DT, gravity=(0.0, 9.81))
    with single_robot() as robot:
        for call, match in (
            (lambda: robot.step([0.0, 0.0]), "tau"),
            (lambda: robot.step([np.nan]), "tau"),
            (lambda: robot.step([0.0], 0), "substeps"),
            (lambda: robot.brake(1, [-1.0]), "torque_limits"),
            (lambda: robot.reset([0.0], [0.0, 0.0]), "v must"),
            (lambda: robot.reset([np.inf], [0.0]), "q must"),
            (lambda: robot.apply_wrench("arm", [0.0], [0.0] * 3), "force"),
            (lambda: robot.apply_wrench("arm", [0.0] * 3, [np.inf] * 3), "torque"),
        ):
            with pytest.raises(ValueError, match=match):
                call()
        for call in (
            lambda: robot.link_pose("hand"),
            lambda: robot.apply_wrench("hand", [0.0] * 3, [0.0] * 3),
        ):
            with pytest.raises(RobotDescriptionError, match="unknown link 'hand'.*base, arm"):
                call()
