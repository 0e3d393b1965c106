# SPDX-License-Identifier: Apache-2.0
"""An arm on a torso that its model has locked: the model follows, and goals wait meanwhile."""

import numpy as np
import pinocchio as pin
import pytest
from controller_chain import ControllerChain, patient_values
from geometry_msgs.msg import PoseStamped

from viability_bounds_pkg.robot.description import build_model, frame_id
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.messages import pose_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS

TORSO = 2
"""Joints of the torso, the first ones of the file."""
ALL = patient_values("talos_left_arm")
N = len(ALL["joints"])
VALUES = {
    name: value[TORSO:] if isinstance(value, list) and len(value) == N else value
    for name, value in ALL.items()
}
Q = np.array([-0.3, 0.5, -0.3, -1.6, 0.0, 0.0, 0.0])
HAND = VALUES["end_effector_frame"]


def model_at(torso) -> pin.Model:
    locked = dict(zip(VALUES["locked_joints"], VALUES["locked_positions"], strict=True))
    locked |= dict(zip(ALL["joints"], torso, strict=False))
    return build_model(
        read_urdf(VALUES["robot_description"]), VALUES["joints"], locked, VALUES["rotor_inertia"]
    )


def hand_at(torso) -> pin.SE3:
    model = model_at(torso)
    data = model.createData()
    pin.framesForwardKinematics(model, data, Q)
    return data.oMf[frame_id(model, HAND)]


class OnTorso(ControllerChain):
    """The other side of the controller: an arm that stands, on a torso."""

    def __init__(self, ros, torso=(0.0, 0.0), **changed) -> None:
        super().__init__(ros, VALUES | {"rate_hz": 50.0} | changed)
        self.poses = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
        self.heard = ros.listen(PoseStamped, "hand_pose")
        self.joints = ALL["joints"]
        self.torso, self.stamp = np.array(torso), 0

    def step(self) -> np.ndarray:
        """Let 20 ms pass; return the torques of the arm."""
        self.stamp += 20
        command = self.ask(self.stamp, [*self.torso, *Q], np.zeros(N))
        return np.array(command.effort)

    def until(self, key, value) -> None:
        self.ros.wait_until(lambda: value in self.reported(key), f"{key} {value}", each=self.step)

    def hand_is_at(self, pose) -> bool:
        p = self.heard[-1].pose.position if self.heard else None
        return p is not None and np.allclose([p.x, p.y, p.z], pose.translation, atol=1e-6)


def test_pose_and_gravity_are_those_of_the_torso_where_it_is(ros, capfd):
    torso = 0.3, 0.4
    arm = OnTorso(ros, torso)
    tau = arm.step()  # from the first state on
    model = model_at(torso)
    gravity = pin.computeGeneralizedGravity(model, model.createData(), Q)
    np.testing.assert_allclose(tau, gravity, atol=1e-6)  # N m
    wrong = model_at((0.0, 0.0))
    assert np.abs(gravity - pin.computeGeneralizedGravity(wrong, wrong.createData(), Q)).max() > 1
    ros.wait_until(lambda: arm.hand_is_at(hand_at(torso)), "the pose", each=arm.step)
    assert "torso_2_joint at 0.400 rad: used in the model" in capfd.readouterr().err


def turn(arm) -> None:
    """Turn the torso by 0.2 rad within 0.4 s."""
    for _ in range(20):
        arm.torso[0] += 0.01
        arm.step()


def test_goals_wait_while_the_torso_moves(ros):
    arm = OnTorso(ros)
    arm.poses.publish(pose_message(hand_at((0.0, 0.0))))
    arm.until("mode", "TRACKING")
    turn(arm)
    arm.until("reason", "torso_1_joint moves, which is locked in the model")
    assert arm.reported("mode") == "HOLD"
    arm.until("mode", "TRACKING")
    off = float(arm.reported("position_error_m"))
    moved = np.linalg.norm(hand_at(arm.torso).translation - hand_at((0.0, 0.0)).translation)
    assert off == pytest.approx(moved, abs=1e-3)  # m


def test_goals_in_the_axes_of_the_torso_move_with_it(ros):
    arm, model = OnTorso(ros, base_frame="torso_2_link"), model_at((0.0, 0.0))
    place = model.frames[frame_id(model, "torso_2_link")].placement
    arm.poses.publish(pose_message(place.actInv(hand_at((0.0, 0.0)))))
    arm.until("mode", "TRACKING")
    changes = arm.reported("mode_changes")
    turn(arm)
    ros.diagnostics.clear()
    arm.until("mode", "TRACKING")
    assert float(arm.reported("position_error_m")) < 1e-6  # m
    assert arm.reported("mode_changes") == changes
