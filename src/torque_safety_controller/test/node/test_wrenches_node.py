# SPDX-License-Identifier: Apache-2.0
"""Wrenches over topics: measured, refused, exerted, yielded to; and what a silent sensor ends."""

import math

import numpy as np
import pinocchio as pin
import pytest
import yaml
from arms import load_arm
from controller_chain import NODE, ControllerChain, controller_of, patient_values
from controllers import pose_at
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from std_srvs.srv import Trigger

from torque_safety_controller.parts.contact.interaction import Interaction
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.description import inertia_beyond
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.messages import pose_message, wrench_message
from viability_bounds_pkg.ros.runtime import CONTROL_QOS, GOAL_QOS
from viability_bounds_pkg.state import State

ARM = load_arm("panda")
VALUES = patient_values("panda") | {
    "ft_frame": "panda_link8",
    "force_directions": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
    "yield_threshold": [10.0, 2.0],
    "contacts": ["{frame: panda_hand, point: [0, 0, 0.1], normal: [0, 0, -1], friction: 0.5}"],
}


def weight() -> np.ndarray:
    """Return what the sensor feels of Panda's hand at the start, shape (6,), N and N m."""
    model, data = ARM.model, ARM.model.createData()
    pin.framesForwardKinematics(model, data, ARM.q_start)
    tool = inertia_beyond(read_urdf(VALUES["robot_description"]), "panda_link8")
    force = (
        tool.mass * data.oMf[model.getFrameId("panda_link8")].rotation.T @ (model.gravity.linear)
    )
    return np.r_[force, np.cross(tool.lever, force)]


WEIGHT = weight()
NOTHING = "", (0.0, 0.0, 0.0)


class WrenchChain(ControllerChain):
    """The other side of the controller, with a force/torque sensor.

    Attributes:
        feels: frame and force that the sensor measures beside the hand's weight, N; None while it
            is silent.
    """

    def __init__(self, ros, **changed) -> None:
        super().__init__(ros, VALUES | changed)
        self.measured = ros.talk(WrenchStamped, "ft_wrench", CONTROL_QOS)
        self.targets = ros.talk(WrenchStamped, "target_wrench", GOAL_QOS)
        self.poses = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
        self.stamp = 0
        self.feels: tuple[str, tuple[float, ...]] | None = None
        self.felt_at = 0  # stamp of the measurements, ns; 0: none

    def step(self) -> np.ndarray:
        """Let 2 ms of robot time pass; return the torques."""
        self.stamp += 2
        if self.feels is not None:
            frame, force = self.feels
            force, torque = force + WEIGHT[:3], WEIGHT[3:]
            self.measured.publish(wrench_message(frame, force, torque, self.felt_at))
        tau = np.array(self.ask(self.stamp, ARM.q_start, np.zeros(ARM.n)).effort)
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= ARM.tau_max).all()
        return tau

    def until(self, key: str, value: str) -> None:
        self.ros.wait_until(lambda: value in self.reported(key), f"{key} {value}", each=self.step)

    def give_pose(self) -> None:
        self.poses.publish(pose_message(pose_at(ARM, ARM.q_start)))
        self.until("mode", "TRACKING")


def test_a_pull_is_yielded_to_until_the_sensor_falls_silent(ros):
    hand = WrenchChain(ros)
    hand.feels = "panda_link8", (1.0, 0.0, 0.0)
    hand.give_pose()
    hand.until("compliance", "holding")
    hand.feels = "panda_link8", (0.0, 30.0, 0.0)
    hand.until("compliance", "yielding")
    assert "threshold" in hand.reported("compliance_reason")
    hand.feels = None
    hand.until("compliance", "sensor silent")
    assert hand.reported("mode") == "TRACKING"
    assert hand.reported("level") == DiagnosticStatus.WARN
    assert "sensor is silent" in hand.reported("message")
    hand.feels = "", (0.0, 30.0, 0.0)
    hand.until("compliance", "yielding")
    # So is one whose driver repeats the last measurement; new ones count in any clock.
    hand.felt_at = 5_000_000_000
    hand.until("compliance", "sensor silent")
    hand.felt_at = 3_000_000_000
    hand.until("compliance_changes", str(int(hand.reported("compliance_changes")) + 2))
    # An empty threshold switches it off.
    hand.felt_at = 0
    hand.until("compliance", "yielding")
    ros.accepts(NODE, yield_threshold=[])
    hand.until("compliance", "off")


def test_measurements_that_are_none_are_dropped_counted_and_named(ros):
    hand = WrenchChain(ros)
    hand.feels = "panda_link8", (0.0, 30.0, math.nan)
    hand.give_pose()
    hand.until("wrenches_refused", "not six finite numbers")
    hand.feels = "moon", (0.0, 30.0, 0.0)
    hand.until("wrenches_refused", "another frame_id")
    hand.feels = "", (0.0, 1e300, 0.0)
    hand.until("wrenches_refused", "beyond 100000 N or N m")
    assert hand.reported("compliance") == "sensor silent"


def test_the_weight_of_a_load_beyond_the_sensor_is_not_felt():
    controller = controller_of(VALUES)
    sensor, robot = controller.find(Interaction).sensor, controller.robot
    controller.reset(ARM.q_start)
    robot.payload.carry("panda_hand", 2.0, [0.0, 0.0, 0.1], np.zeros((3, 3)))
    controller.remodel()
    at_sensor = robot.model.frames[robot.model.getFrameId("panda_link8")].placement.actInv(
        robot.model.frames[robot.model.getFrameId("panda_hand")].placement
    )
    turn = robot.pose.rotation @ at_sensor.rotation.T
    force = 2.0 * turn.T @ robot.model.gravity.linear
    lever = at_sensor.act(np.array([0.0, 0.0, 0.1]))
    sensor.receive(WEIGHT + np.r_[force, np.cross(lever, force)])
    sensor.update(robot.pose.rotation, 1.0)
    np.testing.assert_allclose(sensor.wrench, 0.0, atol=1e-9)


def test_targets_that_cannot_be_exerted_are_refused_and_others_are_exerted(ros):
    """In contact with what gives exactly that back, the motors carry it."""
    hand = WrenchChain(ros, yield_threshold=[])
    hand.feels = NOTHING
    hand.give_pose()
    before = hand.step()
    for k, message in enumerate(
        (
            wrench_message("", (0.0, 0.0, math.inf)),
            wrench_message("", (0.0, 0.0, 1e300)),
            wrench_message("moon", NOTHING[1]),
        )
    ):
        hand.targets.publish(message)
        hand.until("goals_refused", f"target_wrench: {k + 1};")
    assert hand.reported("compliance") != "force"
    hand.targets.publish(wrench_message("panda_hand", (0.0, 0.0, 10.0)))
    hand.feels = "", (0.0, 0.0, -10.0)
    hand.until("compliance", "force")
    robot = ARM.robot(0.0)
    robot.update(State(ARM.q_start, np.zeros(ARM.n)), np.zeros(ARM.n))
    pressed = robot.J.T @ np.array([0.0, 0.0, 10.0, 0.0, 0.0, 0.0])

    def missing():
        return np.abs(hand.step() - before - pressed).max()

    ros.wait_until(lambda: missing() < 0.05, "the torques of the target")  # N m


def test_a_target_ends_when_its_publisher_has_gone(ros, capfd):
    hand = WrenchChain(ros, yield_threshold=[])
    hand.feels = NOTHING
    hand.give_pose()
    hand.targets.publish(wrench_message("panda_hand", (0.0, 0.0, 10.0)))
    hand.until("compliance", "force")
    ros.probe.destroy_publisher(hand.targets)
    hand.until("compliance", "off")
    assert "target_wrench ends: its publisher has gone" in capfd.readouterr().err
    assert hand.reported("mode") == "TRACKING"
    assert float(hand.reported("position_error_m")) < 1e-6  # it holds its place


def test_after_the_strongest_wrenches_that_are_taken_the_arm_goes_on(ros):
    """Sums, squares and filters of larger ones would not be finite for ever."""
    hand = WrenchChain(ros)
    most = 0.999e5  # N; without the weight of the hand
    hand.feels = "panda_link8", (most, -most, most)
    hand.give_pose()
    hand.targets.publish(wrench_message("panda_hand", (1e5, 1e5, -1e5)))
    hand.until("compliance", "force")
    hand.feels = NOTHING
    hand.targets.publish(wrench_message("panda_hand", (0.0, 0.0, 1.0)))
    hand.until("target_wrench", "1")
    for _ in range(200):  # 0.4 s
        hand.step()
    assert hand.reported("mode") == "TRACKING"


def test_a_tare_takes_what_is_felt_for_the_bias_but_not_from_a_hand_that_is_led(ros):
    hand = WrenchChain(ros)
    hand.feels = "", (4.0, 0.0, 0.0)
    hand.give_pose()
    for _ in range(3):
        hand.step()
    answer = ros.call(Trigger, f"{NODE}/tare_ft_sensor", Trigger.Request())
    assert answer.success
    hand.until("ft_bias", "4 ")
    hand.feels = "", (40.0, 0.0, 0.0)
    hand.until("compliance", "yielding")
    answer = ros.call(Trigger, f"{NODE}/tare_ft_sensor", Trigger.Request())
    assert not answer.success
    assert "in contact" in answer.message


# Parameters


def contact(**changed):
    given = {"frame": "panda_hand", "normal": [0.0, 0.0, -1.0], "friction": 0.5} | changed
    return yaml.safe_dump(given, default_flow_style=True)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"ft_frame": "panda_link3"}, "ft_frame"),
        ({"ft_frame": ""}, "force_directions"),
        ({"ft_frame": "", "force_directions": [0.0] * 6}, "yield_threshold"),
        ({"force_directions": [0.5] * 6}, "force_directions"),
        ({"yield_threshold": [0.0, 1.0]}, "yield_threshold"),
        ({"contacts": [contact(), contact(frame="panda_link8")]}, "contacts"),
        ({"contacts": [contact(point=[0.0, 1.0])]}, "contacts[0].point"),
        ({"contacts": [contact(point=[0.0, 0.0, 100.0])]}, "contacts[0].point"),
        ({"contacts": [contact(normal=[0.0, 0.0, 0.0])]}, "contacts[0].normal"),
        ({"contacts": [contact(friction=-0.5)]}, "contacts[0].friction"),
        ({"contacts": [contact(), contact(friction=0.1)]}, "contacts[1].friction"),
        ({"contacts": [contact(frame="panda_link4")]}, "contacts"),
    ],
)
def test_a_wrong_parameter_is_named(changed, named):
    with pytest.raises(SettingError) as error:
        controller_of(VALUES | changed)
    assert error.value.name == named


def test_parameters_reach_the_controller():
    corners = [[x, y, 0.1] for x in (-0.02, 0.02) for y in (-0.01, 0.01)]
    changed = {
        "admittance_kp": [0.2, 0.03],
        "yield_threshold": [3.0, 4.0],
        "contacts": [contact(point=corner) for corner in corners],
    }
    made = controller_of(VALUES | changed).find(Interaction)
    np.testing.assert_array_equal(made.settings.admittance_kp, [0.2, 0.03])
    np.testing.assert_array_equal(made.settings.yield_threshold, [3.0, 4.0])
    np.testing.assert_array_equal(made.contact.points, corners)  # points of a link are one contact
    assert made.contact.friction == 0.5
    off = {"ft_frame": "", "force_directions": [0.0] * 6, "yield_threshold": []}
    assert controller_of(VALUES | off).find(Interaction) is None
