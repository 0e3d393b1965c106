# SPDX-License-Identifier: Apache-2.0
"""Hand and mode as plain topics."""

from controller_chain import MS
from geometry_msgs.msg import PoseStamped
from node_chain import (
    ARM,
    NodeChain,
    Q,
    give_goal,
    pose_at,
)
from std_msgs.msg import String

from torque_safety_controller.node.goal_messages import pose_from_message
from viability_bounds_pkg.ros.runtime import LATCHED_QOS, STATUS_QOS


class Tools(NodeChain):
    """And what tools are shown."""

    def __init__(self, ros, **changed):
        super().__init__(ros, **changed)
        self.hand = ros.listen(PoseStamped, "hand_pose", STATUS_QOS)

    def shown(self, messages, stamp):
        """Wait for a message from now on with a stamp, ms."""
        messages.clear()
        self.ros.wait_until(lambda: stamp * MS in messages.stamps, f"what is shown for {stamp}")
        return messages[messages.stamps.index(stamp * MS)]


def test_the_hand_is_shown_in_the_base_frame(ros):
    chain = Tools(ros)
    chain.answer(1)
    message = chain.shown(chain.hand, 1)
    here = pose_at(Q)
    assert message.header.frame_id == "base"
    assert pose_from_message(message, "base").isApprox(here, 1e-9)


def test_the_hand_is_shown_in_a_base_frame_that_is_not_the_root(ros):
    frame = "left_arm_mount"
    base = ARM.model.frames[ARM.model.getFrameId(frame)].placement
    chain = Tools(ros, base_frame=frame)
    chain.answer(1)
    here = pose_from_message(chain.shown(chain.hand, 1), frame)
    assert here.isApprox(base.actInv(pose_at(Q)), 1e-9)


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
