# SPDX-License-Identifier: Apache-2.0
import math
import re
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from viability_bounds_pkg.baselines import naive_bounds
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import SLOW_QOS, STATUS_QOS
from viability_bounds_pkg.testing.ros_harness import (
    acceleration_limits,
    joint_state,
    names_parameter,
)
from viability_bounds_pkg.viability import BoundsSolver

NODE = "bounds_node"
JOINTS = ["turn", "lift", "spin"]
PERIOD = 0.01  # s
MS = 1_000_000
ELSEWHERE = 200 * MS  # stamps so far apart may be of any states
VALUES = {
    "joints": JOINTS,
    "position_min": [-1.0, -0.5, -math.inf],
    "position_max": [1.0, 2.0, math.inf],
    "velocity_max": [1.0, 2.0, 3.0],
    "acceleration_min": [-10.0, -4.0, -20.0],
    "acceleration_max": [8.0, 5.0, 20.0],
    "rate_hz": 1.0 / PERIOD,
    "bounds_dt_factor": 2.0,
    "state_timeout": 0.2,
}
LIMITS = JointLimits(
    tuple(JOINTS),
    *(
        VALUES[name]
        for name in (
            "position_min",
            "position_max",
            "velocity_max",
            "acceleration_min",
            "acceleration_max",
        )
    ),
)
REST = [0.0, 0.0, 0.0]
# Each joint on its way to its upper limit, braking hard enough for the bounds to be narrow.
NEAR = [0.96, 1.9, 4.0], [0.6, 0.85, 2.95]


def exact(q, v, factor=2.0):
    return BoundsSolver(LIMITS, factor * PERIOD, period=PERIOD).bounds(q, v)


class BoundsProbe:
    """The other side: sends states, keeps answers."""

    def __init__(self, ros, states="joint_states", **changed) -> None:
        self.ros = ros
        self.node = ros.start(BoundsNode, VALUES | changed)
        self.answers = ros.listen(JointTrajectory, "acceleration_limits")
        self.states = ros.talk(JointState, states)
        ros.hears("acceleration_limits")

    def send(self, stamp, q, v, joints=JOINTS) -> None:
        self.states.publish(joint_state(joints, stamp, q, v))

    def ask(self, stamp, q, v, joints=JOINTS) -> JointTrajectory:
        """Send a state until it is answered, return the answer."""
        self.answers.clear()
        self.ros.wait_until(
            lambda: stamp in self.answers.stamps,
            "an answer",
            each=lambda: self.send(stamp, q, v, joints),
            period=0.1,
        )
        return self.answers[self.answers.stamps.index(stamp)]


def check(answer: JointTrajectory, bounds) -> None:
    assert answer.joint_names == JOINTS
    lower, upper = (point.accelerations for point in answer.points)
    np.testing.assert_allclose(lower, bounds.lower, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(upper, bounds.upper, rtol=1e-12, atol=1e-12)


def test_answers_are_those_of_the_solver_with_the_stamp_of_the_state(ros):
    robot = BoundsProbe(ros)
    rng = np.random.default_rng(1)
    seen = set()
    for k in range(1, 41):
        # Some of them outside the limits.
        q = rng.uniform([-1.1, -0.6, -50.0], [1.1, 2.1, 50.0])
        v = rng.uniform(-1.2, 1.2, 3) * VALUES["velocity_max"]
        bounds = exact(q, v)
        check(robot.ask(k * ELSEWHERE + k, q, v), bounds)
        seen.add(tuple(bounds.viable))
    assert len(seen) > 4, "the states hardly differ"


def test_joints_in_any_order_and_others_with_them(ros):
    robot = BoundsProbe(ros)
    order = [2, 0, 1]
    q, v = np.array(NEAR)
    answer = robot.ask(
        10 * MS,
        [*q[order], math.nan],
        [*v[order], 0.0],
        [*(JOINTS[i] for i in order), "other"],
    )
    check(answer, exact(q, v))


def test_distances_to_limits_are_shown_by_joint_until_the_robot_is_silent(ros):
    robot = BoundsProbe(ros, torque_max=[10.0, 20.0, 30.0])
    shown = ros.listen(JointState, "limit_distances", STATUS_QOS)
    states = ros.listen(JointState, "slow/joint_states", SLOW_QOS)
    limits = ros.listen(JointTrajectory, "slow/acceleration_limits", SLOW_QOS)

    def show(stamp, tau):
        state = joint_state(JOINTS, stamp, [0.9, -0.6, 50.0], [0.5, -2.5, 0.0], tau)
        ros.wait_until(lambda: stamp in shown.stamps, each=lambda: robot.states.publish(state))
        return shown[-1]

    message = show(10 * MS, [1.0, -2.0, 40.0])
    assert message.name == JOINTS
    np.testing.assert_allclose(message.position, [0.1, -0.1, math.inf])
    np.testing.assert_allclose(message.velocity, [0.5, -0.5, 3.0])
    np.testing.assert_allclose(message.effort, [9.0, 18.0, -10.0])
    assert not len(show(20 * MS, []).effort)
    # Copies of the streams come with them.
    ros.wait_until(lambda: 20 * MS in states.stamps and 20 * MS in limits.stamps)
    assert (states[-1].name, states[-1].position.tolist()) == (JOINTS, [0.9, -0.6, 50.0])
    assert limits[-1] == robot.answers[-1]
    ros.run_for(VALUES["state_timeout"] + 0.1)
    for each in (shown, states, limits):
        each.clear()
    ros.run_for(0.2)
    assert not shown and not states and not limits


def test_the_same_state_again_gets_the_same_answer_again(ros):
    robot = BoundsProbe(ros)
    first = robot.ask(10 * MS, *NEAR)
    for _ in range(3):
        assert robot.ask(10 * MS, *NEAR) == first
    ros.wait_until(lambda: ros.reported(NODE, "states_answered") == "1", "one state answered")


@pytest.mark.parametrize(
    ("stamp", "q", "v", "joints", "reason"),
    [
        (20, [0.0, math.nan, 0.0], REST, JOINTS, "not finite"),
        (20, REST, [0.0, 0.0, math.inf], JOINTS, "not finite"),
        (20, REST, REST[:2], JOINTS, "wrong size"),
        (20, REST[:2], REST[:2], JOINTS[:2], "missing joint"),
        (20, [], [], [], "missing joint"),
        (5, REST, REST, JOINTS, "old stamp"),
        (0, REST, REST, JOINTS, "no stamp"),
        (10, REST, REST, JOINTS, "other values under the same stamp"),
    ],
)
def test_what_is_wrong_is_dropped_and_counted(ros, stamp, q, v, joints, reason):
    robot = BoundsProbe(ros, state_timeout=30.0)
    robot.ask(10 * MS, *NEAR)
    robot.answers.clear()
    ros.wait_until(
        lambda: re.search(f"{reason}: [1-9]", ros.reported(NODE, "states_refused")),
        f"a refusal: {reason}",
        each=lambda: robot.send(stamp * MS, q, v, joints),
    )
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN
    assert not robot.answers, "what was refused was answered"
    check(robot.ask(ELSEWHERE, *NEAR), exact(*map(np.array, NEAR)))


def test_an_empty_first_message_does_no_harm(ros):
    robot = BoundsProbe(ros)
    ros.wait_until(
        lambda: "missing joint" in ros.reported(NODE, "states_refused"),
        "a refusal",
        each=lambda: robot.send(10 * MS, [], [], []),
    )
    check(robot.ask(20 * MS, *NEAR), exact(*map(np.array, NEAR)))


def test_a_robot_that_starts_over_is_answered_after_the_time_out(ros):
    robot = BoundsProbe(ros)
    begin = time.monotonic()
    robot.ask(5000 * MS, *NEAR)
    check(robot.ask(10 * MS, REST, REST), exact(*np.zeros((2, 3))))
    assert time.monotonic() - begin >= VALUES["state_timeout"]
    check(robot.ask(ELSEWHERE, *NEAR), exact(*map(np.array, NEAR)))
    ros.wait_until(lambda: "old stamp" in ros.reported(NODE, "states_refused"), "the refusals")


def test_diagnostics(ros):
    robot = BoundsProbe(ros)
    ros.wait_until(lambda: ros.reported(NODE, "message") == "no joint state yet")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN
    robot.ask(10 * MS, REST, REST)
    robot.ask(ELSEWHERE, [0.0, 2.1, 0.0], REST)
    robot.ask(2 * ELSEWHERE, [0.0, 2.1, 0.0], [0.0, 0.0, 3.1])
    ros.wait_until(lambda: ros.reported(NODE, "states_answered") == "3")
    report = ros.diagnostics[NODE]
    assert report["level"] == DiagnosticStatus.OK
    assert report["message"] == "answering"
    assert report["method"] == "exact"
    assert report["states_outside_kernel_by_joint"] == "0 2 1"
    assert float(report["control_period_s"]) == pytest.approx(PERIOD)
    assert float(report["bounds_period_s"]) == pytest.approx(2.0 * PERIOD)


DECLARED = {
    "position_error": [1e-3, 2e-3, 0.0],
    "velocity_error": [0.02, 0.0, 0.1],
    "missed_deadlines": 3,
}


def test_it_holds_for_what_is_declared(ros):
    robot = BoundsProbe(ros, **DECLARED)
    q, v = map(np.array, NEAR)
    errors = {name: DECLARED[name] for name in ("position_error", "velocity_error")}
    bounds = BoundsSolver(LIMITS, 4.0 * PERIOD, period=PERIOD, **errors).bounds(q, v)
    assert (bounds.upper < exact(q, v).upper).all(), "what is declared has no effect here"
    check(robot.ask(10 * MS, q, v), bounds)
    ros.wait_until(lambda: ros.reported(NODE, "states_answered") == "1")
    report = ros.diagnostics[NODE]
    assert float(report["bounds_period_s"]) == pytest.approx(4.0 * PERIOD)
    assert [float(x) for x in report["position_error_rad"].split()] == errors["position_error"]
    assert [float(x) for x in report["velocity_error_rad_s"].split()] == errors["velocity_error"]


def test_a_shorter_horizon_than_declared_is_not_taken(ros):
    robot = BoundsProbe(ros, **DECLARED)
    ros.accepts(NODE, bounds_dt_factor=1.0)
    ros.wait_until(lambda: ros.reported(NODE, "bounds_period_s") != "")
    q, v = map(np.array, NEAR)
    errors = {name: DECLARED[name] for name in ("position_error", "velocity_error")}
    bounds = BoundsSolver(LIMITS, 4.0 * PERIOD, period=PERIOD, **errors).bounds(q, v)
    check(robot.ask(10 * MS, q, v), bounds)


def test_it_answers_estimated_states_where_it_is_told_to(ros):
    robot = BoundsProbe(ros, states="estimated_joint_states", use_estimated_states=True)
    missing = "no joint state from estimator_node yet"
    ros.wait_until(lambda: ros.reported(NODE, "message") == missing)
    check(robot.ask(10 * MS, *NEAR), exact(*map(np.array, NEAR)))
    names = {name for name, _ in robot.node.get_topic_names_and_types()}
    assert "/joint_states" not in names


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        (
            {"velocity_error": [0.1, 1.2, 0.1]},
            r"'velocity_error' is .*; allowed: less at 100 Hz \(velocity_error of joint 'lift'",
        ),
        (
            {"position_error": [1.5, 0.0, 0.0], "missed_deadlines": 1},
            r"'position_error' is .*; allowed: less at 100 Hz \(position_error of joint 'turn'",
        ),
        ({"missed_deadlines": -1}, "'missed_deadlines' is -1; allowed: a whole number"),
        ({"delay": 101}, "'delay' is 101; allowed: a whole number"),
        ({"velocity_error": [0.1]}, r"'velocity_error' is \[0.1\]; allowed: 3 numbers"),
        ({"motor_bandwidth": [-1.0, 1.0, 1.0]}, "'motor_bandwidth' is .* >= 0"),
    ],
)
def test_it_does_not_start_with_declarations_that_leave_nothing(shared_ros, changed, line):
    with pytest.raises(SettingError, match=line):
        shared_ros.start(BoundsNode, VALUES | changed)


def test_method_and_horizon_change_while_it_runs(ros):
    robot = BoundsProbe(ros)
    q, v = map(np.array, NEAR)
    check(robot.ask(1 * ELSEWHERE, q, v), exact(q, v))
    ros.accepts(NODE, bounds_dt_factor=4.0)
    check(robot.ask(2 * ELSEWHERE, q, v), exact(q, v, 4.0))
    assert (exact(q, v, 4.0).upper < exact(q, v).upper).all(), "the factor has no effect here"
    ros.accepts(NODE, method="naive")
    naive = naive_bounds(q, v, LIMITS, 4.0 * PERIOD)
    check(robot.ask(3 * ELSEWHERE, q, v), naive)
    assert (naive.upper[:2] > exact(q, v, 4.0).upper[:2]).all(), "the method has no effect here"
    ros.accepts(NODE, method="exact", bounds_dt_factor=1)
    check(robot.ask(4 * ELSEWHERE, q, v), exact(q, v, 1.0))


def test_bad_changes_are_refused_and_the_old_values_keep_working(ros):
    robot = BoundsProbe(ros)
    q, v = map(np.array, NEAR)
    for k, (name, value) in enumerate(
        [
            ("bounds_dt_factor", 0.99),
            ("bounds_dt_factor", -2.0),
            ("bounds_dt_factor", math.nan),
            ("bounds_dt_factor", math.inf),
            ("bounds_dt_factor", "two"),
            ("method", "guess"),
            ("method", ""),
            ("method", 1),
        ]
    ):
        reason = ros.refuses(NODE, **{name: value})
        assert names_parameter(reason, name)
        assert robot.node.get_parameter(name).value == {"method": "exact"}.get(name, 2.0)
        check(robot.ask((k + 1) * ELSEWHERE, q, v), exact(q, v))


def test_a_horizon_that_is_too_long_for_the_limits_is_shortened(ros):
    values = VALUES | {"acceleration_drift": [100.0, 100.0, 100.0]}
    node = ros.start(BoundsNode, values)
    ros.accepts(NODE, bounds_dt_factor=1000.0)
    ros.stop(node)
    slow = VALUES | {"rate_hz": 1.0, "acceleration_drift": [2.3, 0.1, 0.1]}
    ros.refuses_to_start(BoundsNode, slow, "acceleration_drift", "less at 1 Hz (margin of joint")


def test_limits_and_rates_are_read_only(ros):
    robot = BoundsProbe(ros)
    for name, value in (
        ("joints", ["a", "b", "c"]),
        ("position_min", [-9.0, -9.0, -9.0]),
        ("position_max", [9.0, 9.0, 9.0]),
        ("velocity_max", [9.0, 9.0, 9.0]),
        ("acceleration_min", [-9.0, -9.0, -9.0]),
        ("acceleration_max", [9.0, 9.0, 9.0]),
        ("acceleration_drift", [0.0, 0.0, 0.0]),
        ("position_margin", 0.0),
        ("rate_hz", 1000.0),
        ("state_timeout", 1.0),
    ):
        assert "read-only" in ros.refuses(NODE, **{name: value}), name
    q, v = map(np.array, NEAR)
    check(robot.ask(1 * ELSEWHERE, q, v), exact(q, v))


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"position_min": [-1.0, 2.0, -math.inf]}, "position_max", "2"),
        ({"position_min": [-1.0, 2.5, -math.inf]}, "position_max", "2"),
        ({"position_min": [math.inf, -0.5, -math.inf]}, "position_min", "inf"),
        ({"position_min": [math.nan, -0.5, 0.0]}, "position_min", "nan"),
        ({"position_max": [1.0, 2.0]}, "position_max", "[1, 2]"),
        ({"position_max": [1.0, 2.0, 3.0, 4.0]}, "position_max", "[1, 2, 3, 4]"),
        ({"velocity_max": [1.0, 0.0, 3.0]}, "velocity_max", "0"),
        ({"velocity_max": [1.0, -2.0, 3.0]}, "velocity_max", "-2"),
        ({"velocity_max": [1.0, math.inf, 3.0]}, "velocity_max", "inf"),
        ({"acceleration_min": [-1.0, 0.0, -1.0]}, "acceleration_min", "0"),
        ({"acceleration_min": [-1.0, 4.0, -1.0]}, "acceleration_min", "4"),
        ({"acceleration_max": [1.0, -4.0, 1.0]}, "acceleration_max", "-4"),
        ({"acceleration_max": [1.0, math.nan, 1.0]}, "acceleration_max", "nan"),
        ({"acceleration_drift": [1.0]}, "acceleration_drift", "[1]"),
        ({"acceleration_drift": [1.0, -1.0, 1.0]}, "acceleration_drift", "-1"),
        ({"acceleration_drift": [1.0, math.inf, 1.0]}, "acceleration_drift", "inf"),
        ({"position_margin": -1e-3}, "position_margin", "-0.001"),
        ({"position_margin": math.nan}, "position_margin", "nan"),
        ({"torque_max": [1.0]}, "torque_max", "3 numbers"),
        ({"robot_description": "/nowhere.urdf"}, "robot_description", "/nowhere.urdf"),
        ({"joints": ["turn", "lift", "turn"]}, "joints", "['turn', 'lift', 'turn']"),
        ({"joints": ["turn", "", "spin"]}, "joints", "['turn', '', 'spin']"),
        ({"joints": None}, "joints", "not set"),
        ({"velocity_max": None}, "velocity_max", "not set"),
        ({"rate_hz": None}, "rate_hz", "not set"),
        ({"rate_hz": 0.0}, "rate_hz", "0"),
        ({"rate_hz": -100.0}, "rate_hz", "-100"),
        ({"rate_hz": math.inf}, "rate_hz", "inf"),
        ({"method": "magic"}, "method", "'magic'"),
        ({"bounds_dt_factor": 0.5}, "bounds_dt_factor", "0.5"),
        ({"bounds_dt_factor": math.nan}, "bounds_dt_factor", "nan"),
        ({"state_timeout": 0.0}, "state_timeout", "0"),
    ],
)
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name, shown):
    shared_ros.refuses_to_start(BoundsNode, VALUES | changed, name, shown)


def test_a_second_robot_can_use_what_it_answers(ros):
    # The format that the controller takes; see the table of topics.
    robot = BoundsProbe(ros)
    q, v = map(np.array, NEAR)
    bounds = exact(q, v)
    answer = robot.ask(10 * MS, q, v)
    assert answer == acceleration_limits(JOINTS, 10 * MS, bounds.lower, bounds.upper)
