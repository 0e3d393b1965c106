# SPDX-License-Identifier: Apache-2.0
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from sim_bridge.node.run_recorder import RunRecorder
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.diagnostics import Diagnostics

NAMESPACES = ("", "left", "left/wrist", "right")


class Player(ArmNode):
    NAME = "player"


@pytest.mark.parametrize("own", NAMESPACES)
def test_diagnostics_of_arms_in_other_namespaces_are_ignored(ros, own):
    for namespace in NAMESPACES:
        robot = ros.add(Node("bullet_node", context=ros.context, namespace=namespace))
        report = DiagnosticStatus.OK, "", {"arm": namespace}
        Diagnostics(robot, lambda report=report: report)
    node = ros.add(Player(context=ros.context, namespace=own))
    recorder, told = RunRecorder(node, ["x"]), []

    def all_told():
        told.append(recorder.diagnostics["bullet_node"].get("arm"))
        return len(ros.diagnostics) == len(NAMESPACES) and told[-1] is not None

    ros.wait_until(all_told)
    ros.diagnostics.clear()
    ros.wait_until(all_told)
    assert {arm for arm in told if arm is not None} == {own}
