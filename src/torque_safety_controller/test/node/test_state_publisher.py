# SPDX-License-Identifier: Apache-2.0
"""Hand and mode as plain topics."""

import numpy as np
import pinocchio as pin
import pytest
from controller_chain import MS
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from node_chain import (
    ARM,
    GOAL,
    NodeChain,
    Q,
    give_goal,
    pose_at,
    pose_message,
)
from std_msgs.msg import String

from torque_safety_controller.node.goals import pose_from_message
from viability_bounds_pkg.ros.runtime import LATCHED_QOS, STATUS_QOS


class Tools(NodeChain):
    """And what tools are shown."""

    def __init__(self, ros, **changed):
        super().__init__(ros, **changed)
        self.hand = ros.listen(PoseStamped, "hand_pose", STATUS_QOS)
        self.translation = ros.listen(Vector3Stamped, "hand_position_error", STATUS_QOS)
        self.rotation = ros.listen(Vector3Stamped, "hand_orientation_error", STATUS_QOS)

    def shown(self, messages, stamp):
        """Wait for a message from now on with a stamp, ms."""
        messages.clear()
        self.ros.wait_until(lambda: stamp * MS in messages.stamps, f"what is shown for {stamp}")
        return messages[messages.stamps.index(stamp * MS)]

    def error(self, stamp):
        """Wait for the errors under a stamp, ms; return both."""
        both = self.shown(self.translation, stamp), self.shown(self.rotation, stamp)
        assert {message.header.frame_id for message in both} == {"base"}
        return [np.array([m.vector.x, m.vector.y, m.vector.z]) for m in both]


def test_the_hand_is_shown_with_its_error_where_it_has_a_goal(ros):
    chain = Tools(ros)
    chain.answer(1)
    message = chain.shown(chain.hand, 1)
    here = pose_at(Q)
    assert message.header.frame_id == "base"
    assert pose_from_message(message, "base").isApprox(here, 1e-9)
    assert not chain.translation and not chain.rotation  # there is no goal
    stamp = give_goal(chain, first=2)
    chain.answer(stamp)
    translation, rotation = chain.error(stamp)
    np.testing.assert_allclose(translation, GOAL.translation - here.translation, atol=1e-9)
    np.testing.assert_allclose(pin.exp3(rotation) @ here.rotation, GOAL.rotation, atol=1e-9)
    assert np.linalg.norm(rotation) > 0.05


def test_the_hand_is_shown_in_a_base_frame_that_is_not_the_root(ros):
    frame = "left_arm_mount"
    base = ARM.model.frames[ARM.model.getFrameId(frame)].placement
    chain = Tools(ros, base_frame=frame)
    goal = base.actInv(GOAL)
    stamp = give_goal(chain, pose_message(goal, frame))
    chain.answer(stamp)
    here = pose_from_message(chain.shown(chain.hand, stamp), frame)
    assert here.isApprox(base.actInv(pose_at(Q)), 1e-9)
    error = chain.shown(chain.translation, stamp)
    assert error.header.frame_id == frame
    wanted = (goal.translation - here.translation).tolist()
    assert [error.vector.x, error.vector.y, error.vector.z] == pytest.approx(wanted)


def test_nothing_is_shown_once_the_robot_is_silent(ros):
    chain = Tools(ros, bounds_timeout=0.1, state_timeout=0.3)
    chain.answer(1)
    chain.shown(chain.hand, 1)
    chain.await_mode("STOPPED")
    ros.run_for(0.02)
    chain.hand.clear()
    ros.run_for(0.2)
    assert not chain.hand


def test_the_hand_is_shown_in_position_control_too(ros):
    chain = Tools(ros, start_control="position")
    for stamp, q in ((1, Q), (2, Q + 0.001)):
        chain.await_command(stamp, lambda stamp=stamp, q=q: chain.both(stamp, q))
        shown = pose_from_message(chain.shown(chain.hand, stamp), "base")
        assert shown.isApprox(pose_at(q), 1e-9)


def test_the_mode_is_shown_when_it_changes_and_to_who_comes_late(ros):
    chain = NodeChain(ros)
    modes = ros.listen(String, "controller_mode", LATCHED_QOS)
    ros.wait_until(lambda: modes, "the mode at start")
    chain.answer(1)
    ros.wait_until(lambda: modes[-1].data == "HOLD", "the mode")
    stamp = give_goal(chain, first=2)
    ros.wait_until(lambda: modes[-1].data == "TRACKING", "the mode")
    for _ in range(3):
        chain.answer(stamp)
        stamp += 1
    assert [mode.data for mode in modes] == ["STOPPED", "HOLD", "TRACKING"]
    late = ros.listen(String, "controller_mode", LATCHED_QOS)
    ros.wait_until(lambda: late, "the mode again")
    assert [mode.data for mode in late] == ["TRACKING"]
