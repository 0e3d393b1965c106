# SPDX-License-Identifier: Apache-2.0
"""The bounds node: joint states in, acceleration limits out."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from viability_bounds_pkg import uncertainty
from viability_bounds_pkg.baselines import naive_bounds
from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import NEWEST_QOS, STATUS_QOS, set_stamp
from viability_bounds_pkg.testing.ros_harness import joint_state
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
    VALUES["position_min"],
    VALUES["position_max"],
    VALUES["velocity_max"],
    VALUES["acceleration_min"],
    VALUES["acceleration_max"],
)
CURVE = {"velocity_offset": [0.2, 0.1, 0.0], "deceleration_limit": [5.0, 3.0, math.inf]}
JERK = {"jerk_max": [9.0, 9.0, 9.0]}
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


def test_answers_are_the_exact_bounds_with_the_stamp_of_the_state(ros):
    robot = BoundsProbe(ros)
    rng = np.random.default_rng(1)
    seen = set()
    for k in range(1, 16):
        # Some of them outside the limits.
        q = rng.uniform([-1.1, -0.6, -50.0], [1.1, 2.1, 50.0])
        v = rng.uniform(-1.2, 1.2, 3) * VALUES["velocity_max"]
        bounds = exact(q, v)
        answer = robot.ask(k * ELSEWHERE + k, q, v)
        check(answer, bounds)
        seen.add(tuple(bounds.viable))
    assert len(seen) > 4, "the states hardly differ"
    # The same state again gets the same answer and does not count, whatever the order of names.
    order = [2, 0, 1]
    names = [*(JOINTS[i] for i in order), "other"]
    again = robot.ask(k * ELSEWHERE + k, [*q[order], math.nan], [*v[order], 0.0], names)
    assert again == answer
    ros.wait_until(lambda: ros.reported(NODE, "states_answered") == "15", "15 states")


def test_distances_to_limits_are_shown_by_joint_until_the_robot_is_silent(ros):
    robot = BoundsProbe(ros, torque_max=[10.0, 20.0, 30.0], **CURVE)
    shown = ros.listen(JointState, "limit_distances", STATUS_QOS)
    states = ros.listen(JointState, "slow/joint_states", NEWEST_QOS)
    limits = ros.listen(JointTrajectory, "slow/acceleration_limits", NEWEST_QOS)

    def show(stamp, tau):
        state = joint_state(JOINTS, stamp, [0.9, -0.6, 50.0], [0.5, -2.5, 0.0], tau)
        ros.wait_until(lambda: stamp in shown.stamps, each=lambda: robot.states.publish(state))
        return shown[-1]

    message = show(10 * MS, [1.0, -2.0, 40.0])
    assert message.name == JOINTS
    np.testing.assert_allclose(message.position, [0.1, -0.1, math.inf])
    # The first may move by sqrt(2 * 5 * 0.1) - 0.2 rad/s, the second only back.
    np.testing.assert_allclose(message.velocity, [0.3, -2.5, 3.0])
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


WRONG = [("not finite", 30, math.nan), ("old stamp", 10, 0.0), ("impossible", 30, 99.0)]


def test_what_is_wrong_is_dropped_and_counted(ros):
    """All reasons are in test_messages.py."""
    robot = BoundsProbe(ros, state_timeout=30.0)
    ros.wait_until(
        lambda: "missing joint: " in ros.reported(NODE, "states_refused"),
        "a refusal of an empty first message",
        each=lambda: robot.send(10 * MS, [], [], []),
    )
    check(robot.ask(20 * MS, *NEAR), exact(*map(np.array, NEAR)))
    robot.answers.clear()
    for reason, stamp, turn in WRONG:
        ros.wait_until(
            lambda text=reason: text in ros.reported(NODE, "states_refused"),
            reason,
            each=lambda k=stamp, q=turn: robot.send(k * MS, [q, 0.0, 0.0], REST),
        )
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN
    assert not robot.answers, "what was refused was answered"
    check(robot.ask(ELSEWHERE, *NEAR), exact(*map(np.array, NEAR)))


def test_a_robot_that_starts_over_is_answered_after_the_time_out(ros):
    robot = BoundsProbe(ros)
    robot.ask(5000 * MS, *NEAR)
    check(robot.ask(10 * MS, REST, REST), exact(*np.zeros((2, 3))))
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
    assert (report["level"], report["message"]) == (DiagnosticStatus.OK, "answering")
    assert report["method"] == "exact"
    assert report["states_outside_kernel_by_joint"] == "0 2 1"
    assert float(report["control_period_s"]) == pytest.approx(PERIOD)
    assert float(report["bounds_period_s"]) == pytest.approx(2.0 * PERIOD)


def test_it_holds_for_what_is_declared_whatever_the_horizon(ros):
    errors = {"position_error": [1e-3, 2e-3, 0.0], "velocity_error": [0.02, 0.0, 0.1]}
    robot = BoundsProbe(ros, missed_deadlines=3, **errors)
    q, v = map(np.array, NEAR)
    bounds = BoundsSolver(LIMITS, 4.0 * PERIOD, period=PERIOD, **errors).bounds(q, v)
    assert (bounds.upper < exact(q, v).upper).all(), "what is declared has no effect here"
    check(robot.ask(10 * MS, q, v), bounds)
    ros.accepts(NODE, bounds_dt_factor=1.0)  # shorter than what is declared
    check(robot.ask(ELSEWHERE, q, v), bounds)
    ros.wait_until(lambda: ros.reported(NODE, "states_answered") == "2")
    report = ros.diagnostics[NODE]
    assert float(report["bounds_period_s"]) == pytest.approx(4.0 * PERIOD)
    assert [float(x) for x in report["position_error_rad"].split()] == errors["position_error"]
    assert [float(x) for x in report["velocity_error_rad_s"].split()] == errors["velocity_error"]


def test_it_answers_estimated_states_where_it_is_told_to(ros):
    robot = BoundsProbe(ros, states="estimated_joint_states", use_estimated_states=True)
    missing = "no joint state from estimator_node yet"
    ros.wait_until(lambda: ros.reported(NODE, "message") == missing)
    check(robot.ask(10 * MS, *NEAR), exact(*map(np.array, NEAR)))
    names = {name for name, _ in robot.node.get_topic_names_and_types()}
    assert "/joint_states" not in names


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
    for name, value in (("bounds_dt_factor", 0.99), ("method", "guess"), ("rate_hz", 1e3)):
        ros.refuses(NODE, **{name: value})
    check(robot.ask(4 * ELSEWHERE, q, v), exact(q, v, 1.0))


def test_bounds_are_prepared_once_for_each_change(ros, monkeypatch):
    made = []
    monkeypatch.setattr(
        uncertainty, "BoundsSolver", lambda *a, **k: made.append(1) or BoundsSolver(*a, **k)
    )
    ros.start(BoundsNode, VALUES)
    assert len(made) == 1
    ros.accepts(NODE, bounds_dt_factor=3.0)
    assert len(made) == 2


def test_with_a_limited_jerk_it_goes_by_what_was_commanded(ros):
    robot = BoundsProbe(ros, jerk_max=[100.0, 100.0, 100.0])
    commands = ros.talk(JointTrajectory, "commanded_accelerations")
    ros.hears("commanded_accelerations")
    solver = JerkBoundsSolver(LIMITS, [100.0] * 3, PERIOD, 2.0 * PERIOD)
    (q, v), zero = map(np.array, NEAR), np.zeros(3)
    bounds = solver.bounds(q, v, zero)
    check(robot.ask(10 * MS, q, v), bounds)
    # Nobody says what was commanded: any of these.
    bounds = solver.bounds(q, v, bounds.lower, bounds.upper)
    check(robot.ask(20 * MS, q, v), bounds)
    last = np.array([-1.2, 0.3, -0.8])
    for stamp, wrong in ((20, last[:2]), (20, last * math.nan), (10, 2.0 * last), (20, last)):
        point = JointTrajectoryPoint(accelerations=wrong.tolist())
        message = JointTrajectory(joint_names=JOINTS, points=[point])
        set_stamp(message.header.stamp, stamp * MS)
        commands.publish(message)
        ros.run_for(0.05)
    check(robot.ask(30 * MS, q, v), solver.bounds(q, v, last))
    ros.wait_until(lambda: "not finite" in ros.reported(NODE, "accelerations_refused"))
    assert "wrong size" in ros.reported(NODE, "accelerations_refused")
    assert ros.reported(NODE, "last_acceleration_unknown") == "1"
    # After a restart nothing is known to accelerate the arm.
    check(robot.ask(ELSEWHERE * 10, q, v), solver.bounds(q, v, zero))
    ros.accepts(NODE, bounds_dt_factor=1.0)
    solver = JerkBoundsSolver(LIMITS, [100.0] * 3, PERIOD)
    check(robot.ask(ELSEWHERE * 20, q, v), solver.bounds(q, v, zero))
    ros.refuses(NODE, method="naive")


def test_a_jerk_that_is_too_small_for_all_braking_is_told(ros, capfd):
    ros.start(BoundsNode, VALUES | {"jerk_max": [20.0, 200.0, 20.0]})
    lines = capfd.readouterr().err.splitlines()
    (line,) = (each for each in lines if "jerk_max" in each)
    assert "joint 'turn' has too small a jerk_max for all of its braking" in line
    assert "decelerations of 6.12 before the upper limit and 6.12 before the lower one" in line


def test_a_horizon_that_is_too_long_for_the_limits_is_shortened(shared_ros):
    values = VALUES | {"acceleration_drift": [100.0, 100.0, 100.0], "bounds_dt_factor": 1000.0}
    shared_ros.stop(shared_ros.start(BoundsNode, values))
    slow = VALUES | {"rate_hz": 1.0, "acceleration_drift": [2.3, 0.1, 0.1]}
    line = "less at 1 Hz (margin of joint"
    shared_ros.refuses_to_start(BoundsNode, slow, "acceleration_drift", line)


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"position_min": [math.inf, -0.5, -math.inf]}, "position_min", "inf"),
        ({"acceleration_min": [-1.0, 0.0, -1.0]}, "acceleration_min", "0"),
        ({"acceleration_drift": [1.0, -1.0, 1.0]}, "acceleration_drift", "-1"),
        ({"position_margin": -1e-3}, "position_margin", "-0.001"),
        ({"torque_max": [1.0]}, "torque_max", "3 numbers"),
        ({"velocity_offset": [0.1, 0.1, 0.0]}, "deceleration_limit", "as the other is given"),
        ({"deceleration_limit": [5.0, 5.0, math.inf]}, "velocity_offset", "3 numbers"),
        (CURVE | {"deceleration_limit": [5.0, 0.0, math.inf]}, "deceleration_limit", "> 0"),
        (CURVE | {"velocity_offset": [0.1, 0.1, 0.1]}, "velocity_offset", "is .inf"),
        (CURVE | {"velocity_offset": [9.0, 0.1, 0.0]}, "velocity_offset", "9, 0.1, 0"),
        ({"bounds_dt_factor": math.nan}, "bounds_dt_factor", "nan"),
        ({"missed_deadlines": -1}, "missed_deadlines", "-1; allowed: a whole number"),
        ({"motor_bandwidth": [-1.0, 1.0, 1.0]}, "motor_bandwidth", ">= 0"),
        ({"jerk_max": [9.0, 0.0, 9.0]}, "jerk_max", "0"),
        (JERK | {"velocity_error": [0.0, 0.1, 0.0]}, "jerk_max", "none where 'velocity_error'"),
        (JERK | {"missed_deadlines": 1}, "jerk_max", "none where 'missed_deadlines' is given"),
        (JERK | {"use_estimated_states": True}, "jerk_max", "none where 'use_estimated_states'"),
        (JERK | {"method": "naive"}, "jerk_max", "none where 'method' is given"),
        (JERK | CURVE, "jerk_max", "deceleration_limit of joint 'turn' is 5.0; must be inf"),
        (JERK | {"acceleration_disturbance": [1.0, 3.9, 0.0]}, "jerk_max", "with this jerk"),
        # Declarations that leave nothing.
        ({"velocity_error": [0.1, 1.2, 0.1]}, "velocity_error", "less at 100 Hz (velocity_error"),
    ],
)
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name, shown):
    shared_ros.refuses_to_start(BoundsNode, VALUES | changed, name, shown)
