# SPDX-License-Identifier: Apache-2.0
"""Two arms in two namespaces of one ROS domain, in lockstep."""

import numpy as np
import yaml
from chain import load_values
from std_srvs.srv import Trigger

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.testing.ros_harness import RosHarness, overrides, private_domain

LOCKSTEP = {
    "clock": "lockstep",
    "start_paused": True,
    "bounds_timeout": 20.0,
    "state_timeout": 40.0,
}
DURATION = 0.2  # s of robot time
RECORDED = ("t", "q", "v", "a_lower", "a_upper", "tau", "ft_wrench", "answered")
PANDA = {
    "posture": {"panda_joint4": -2.0, "panda_joint6": 1.4},
    "push": {"link": "panda_link5", "force": [0.0, 20.0, 0.0]},
    "values": {"posture_kp": 40.0},
}
"""What happens to an arm: joints of its posture that move, a push, new values of parameters."""
BAXTER = {
    "posture": {"left_s1": -0.6},
    "push": {"link": "left_lower_elbow", "force": [0.0, 0.0, 10.0]},
    "values": {"posture_kp": 30.0},
}


class Arm:
    """The nodes of an arm with a scenario.

    Attributes:
        controller, player: its nodes for control and scenario.
    """

    def __init__(self, ros, directory, robot, happens, namespace="") -> None:
        values = load_values(robot) | LOCKSTEP
        start = dict(zip(values["joints"], values["start_positions"], strict=True))
        events = [
            {"time": 0.0, "posture": start | happens["posture"]},
            {"time": 0.04, "push": happens["push"] | {"duration": 0.05}},
            {"time": 0.1, "parameters": {"node": "controller_node", "values": happens["values"]}},
        ]
        path = directory / f"{robot}_{namespace}.yaml"
        path.write_text(yaml.safe_dump({"duration": DURATION, "events": events}))
        values["scenario"] = str(path)
        _, self.controller, _, self.player = (
            ros.add(
                kind(
                    context=ros.context, namespace=namespace, parameter_overrides=overrides(values)
                )
            )
            for kind in (BoundsNode, ControllerNode, BulletNode, ScenarioNode)
        )

    def recorded(self) -> dict[str, np.ndarray]:
        assert self.player.failure is None
        run = self.player.recorded_run()
        return {name: getattr(run, name) for name in RECORDED}


def play(ros, *arms) -> None:
    ros.wait_until(
        lambda: all(arm.player.ended.done() for arm in arms), "the scenarios", timeout=300.0
    )


def alone(directory, robot, happens):
    """Return what an arm records that has the ROS graph for itself."""
    with private_domain() as domain:
        ros = RosHarness(domain)
        try:
            arm = Arm(ros, directory, robot, happens)
            play(ros, arm)
            return arm.recorded()
        finally:
            ros.close()


def test_each_arm_does_what_it_does_alone(ros, tmp_path):
    left = Arm(ros, tmp_path, "panda", PANDA, "left")
    right = Arm(ros, tmp_path, "baxter_left_arm", BAXTER, "right")
    play(ros, left, right)
    for arm, own in ((left, ("panda", PANDA)), (right, ("baxter_left_arm", BAXTER))):
        recorded, expected = arm.recorded(), alone(tmp_path, *own)
        assert len(expected["t"]) > 10
        for name in RECORDED:
            np.testing.assert_array_equal(recorded[name], expected[name], err_msg=name)
        assert arm.player.robot["topics_with_several_publishers"] == "none"
        assert arm.controller.get_parameter("posture_kp").value == own[1]["values"]["posture_kp"]
    start, end = load_values("panda")["start_positions"], right.player.recorder.q
    assert ros.call(Trigger, "/left/bullet_node/reset", Trigger.Request()).success
    ros.wait_until(lambda: np.allclose(left.player.recorder.q, start), "the start")
    np.testing.assert_array_equal(right.player.recorder.q, end)


def test_no_topic_or_service_of_two_arms_is_shared(ros, tmp_path):
    for side in ("left", "right"):
        Arm(ros, tmp_path, "panda", PANDA, side)

    def names(prefix="/"):
        graph = ros.probe.get_topic_names_and_types() + ros.probe.get_service_names_and_types()
        found = {name for name, _ in graph if name.startswith(prefix)}
        return {name.removeprefix(prefix) for name in found}

    def all_found():
        left = names("/left/")
        return left == names("/right/") and {"target_posture", "bullet_node/reset"} <= left

    ros.wait_until(all_found, "the same topics and services on both sides")
    shared = {name for name in names() if not name.startswith(("left/", "right/", "probe/"))}
    assert shared == {"diagnostics", "parameter_events", "rosout"}
