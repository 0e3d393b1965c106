# SPDX-License-Identifier: Apache-2.0
"""Joint states from messages: which are accepted, and what is said of the others."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from rclpy.node import Node
from rclpy.parameter import Parameter

from viability_bounds_pkg.plausible import PlausibilityCheck
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import Arrival, JointStateReader
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import joint_state

JOINTS = ("a", "b", "c")
Q, V = [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]
SECOND = 1_000_000_000
NONE = np.zeros(3)


def make_reader(**arguments):
    """Return a reader that has got a state."""
    reader = JointStateReader(JOINTS, reset_after=0.5, **arguments)
    assert reader.read(joint_state(JOINTS, SECOND, Q, V), now=10.0) is Arrival.NEW
    return reader


def holds(reader, q, v, stamp):
    np.testing.assert_array_equal(reader.q, q)
    np.testing.assert_array_equal(reader.v, v)
    assert reader.stamp == stamp


NUMBERS = st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6)


@given(order=st.permutations(range(6)), q=NUMBERS, v=NUMBERS)
def test_joints_may_come_in_any_order_with_others_of_which_nothing_matters(order, q, v):
    reader = make_reader()
    names = [*JOINTS, "x", "y", "z"]
    q, v = [*q[:5], math.nan], [*v[:4], math.inf, v[5]]
    message = joint_state(
        [names[i] for i in order], 2 * SECOND, [q[i] for i in order], [v[i] for i in order]
    )
    assert reader.read(message, 10.01) is Arrival.NEW
    holds(reader, q[:3], v[:3], 2 * SECOND)
    assert reader.read(joint_state(JOINTS, 3 * SECOND, Q, V), 10.02) is Arrival.NEW
    holds(reader, Q, V, 3 * SECOND)


@pytest.mark.parametrize(
    ("message", "reason", "detail"),
    [
        (joint_state(JOINTS, 2 * SECOND, [0.0, math.nan, 0.0], V), "not finite", "a position or"),
        (joint_state(JOINTS, 2 * SECOND, Q, [math.inf, 0.0, -math.inf]), "not finite", ""),
        (joint_state(JOINTS, 2 * SECOND, Q[:2], V), "wrong size", "3 names, 2 positions"),
        (joint_state(JOINTS, 2 * SECOND, Q, []), "wrong size", ""),
        (joint_state([*JOINTS, "x"], 2 * SECOND, Q, V), "wrong size", ""),
        (joint_state(["a", "b", "x"], 2 * SECOND, Q, V), "missing joint", "there is no 'c'"),
        (joint_state([], 2 * SECOND), "missing joint", ""),
        (joint_state([*JOINTS, "b"], 2 * SECOND, [*Q, 0], [*V, 0]), "joint twice", "'b' a second"),
        (joint_state(JOINTS, SECOND - 1, Q, V), "old stamp", ""),
        (joint_state(JOINTS, 0, Q, V), "no stamp", "header.stamp is zero"),
        (joint_state(JOINTS, -5 * SECOND, Q, V), "no stamp", "header.stamp is before zero"),
        (joint_state(JOINTS, SECOND, V, V), "other values under the same stamp", ""),
    ],
)
def test_what_is_refused_is_counted_told_once_and_changes_nothing(message, reason, detail):
    warnings = []
    reader = make_reader(warn=warnings.append)
    for _ in range(2):
        assert reader.read(message, 10.01) is Arrival.REFUSED
        holds(reader, Q, V, SECOND)
    assert reader.refused == {reason: 2}
    (line,) = warnings
    assert line.startswith(f"joint_states refused: {reason}")
    assert detail in line
    assert reader.read(joint_state(JOINTS, 3 * SECOND, V, Q), 10.03) is Arrival.NEW
    holds(reader, V, Q, 3 * SECOND)


@pytest.mark.parametrize("missing", [[], [math.nan] * 3], ids=["none", "nan"])
def test_where_velocities_are_not_needed_those_of_the_positions_stand_for_missing_ones(missing):
    reader = JointStateReader(JOINTS, reset_after=0.5, needs_velocities=False)
    moved = np.array(Q) + [0.01, 0.0, -0.02]
    for k, now, q, v in (
        (100, 10.0, Q, NONE),
        (101, 10.01, moved, [1.0, 0.0, -2.0]),
        (1, 11.0, Q, NONE),  # started over
    ):
        message = joint_state(JOINTS, k * SECOND // 100, q, missing)
        assert reader.read(message, now) is Arrival.NEW
        np.testing.assert_allclose(reader.v, v, atol=1e-9)  # rad/s
        assert reader.read(message, now) is Arrival.REPEATED
        answer = reader.with_state(State(reader.q, reader.v + 1.0))
        np.testing.assert_array_equal(answer.velocity, reader.v + 1.0)
    assert reader.read(joint_state(JOINTS, SECOND, Q, [math.inf] * 3), 11.01) is Arrival.REFUSED


def test_a_continuous_joint_does_not_leap_where_its_angle_wraps():
    limit = np.array([math.inf, 4.0, 4.0])
    check = PlausibilityCheck(-limit, limit, np.full(3, 2.5), 0.01, NONE, NONE)
    continuous = np.isinf(limit)
    reader = JointStateReader(JOINTS, reset_after=0.5, check=check, continuous=continuous)
    true = 3.1 + 0.02 * np.arange(8)
    for k, q in enumerate(true, 1):
        wrapped = (q + np.pi) % (2.0 * np.pi) - np.pi
        message = joint_state(JOINTS, k * SECOND // 100, [wrapped, 3.1, -3.1], [2.0, 0.0, 0.0])
        assert reader.read(message, 10.0 + 0.01 * k) is Arrival.NEW
        assert reader.read(message, 10.0 + 0.01 * k) is Arrival.REPEATED
        np.testing.assert_allclose(reader.q, [q, 3.1, -3.1], atol=1e-12)  # rad
        np.testing.assert_allclose(reader.q - reader.turns, message.position, atol=1e-12)
        answer = reader.with_state(State(reader.q, reader.v))
        np.testing.assert_allclose(answer.position, message.position, atol=1e-12)
    assert wrapped < 0.0
    other = joint_state(JOINTS, 9 * SECOND // 100, [wrapped, -3.1, -3.1], NONE)
    assert reader.read(other, 10.1) is Arrival.REFUSED  # it has limits


def test_the_same_message_again_is_a_repeat():
    reader = make_reader()
    for now in (10.1, 100.0):
        assert reader.read(joint_state(JOINTS, SECOND, Q, V), now) is Arrival.REPEATED
    assert not reader.refused


@pytest.mark.parametrize("stamp", [5, SECOND], ids=["earlier", "the same"])
def test_a_source_that_starts_over_is_taken_after_silence(stamp):
    reader = make_reader()
    restarted = joint_state(JOINTS, stamp, V, Q)
    assert reader.read(restarted, 10.49) is Arrival.REFUSED
    assert reader.read(restarted, 10.51) is Arrival.NEW
    holds(reader, V, Q, stamp)
    assert reader.read(joint_state(JOINTS, stamp + 1, Q, V), 10.52) is Arrival.NEW


def test_one_corrupt_stamp_in_the_future_does_not_lock_the_robot_out():
    reader = make_reader()
    assert reader.read(joint_state(JOINTS, 1000 * SECOND, Q, V), 10.01) is Arrival.NEW
    assert reader.read(joint_state(JOINTS, 2 * SECOND, Q, V), 10.50) is Arrival.REFUSED
    assert reader.read(joint_state(JOINTS, 2 * SECOND, Q, V), 10.52) is Arrival.NEW


def test_impossible_states_are_refused_until_they_are_plausible_again_or_stay():
    limit = np.full(3, 2.5)
    check = PlausibilityCheck(-limit, limit, limit, 0.01, NONE, NONE)
    reader = JointStateReader(JOINTS, reset_after=0.5, check=check)

    def arrives(k, q, now):
        return reader.read(joint_state(JOINTS, k * SECOND // 100, q, NONE), now)

    assert arrives(1, Q, 10.00) is Arrival.NEW
    assert arrives(2, V, 10.01) is Arrival.REFUSED
    assert arrives(3, Q, 10.02) is Arrival.NEW
    assert reader.refused == {"impossible": 1}
    # As a robot does that waits for an answer.
    for now in (10.03, 10.07, 10.51):
        assert arrives(4, V, now) is Arrival.REFUSED
    assert arrives(4, V, 10.54) is Arrival.NEW


def test_what_is_refused_is_no_sign_of_life():
    reader = make_reader()
    early = joint_state(JOINTS, SECOND // 2, Q, V)
    assert reader.read(early, 10.3) is Arrival.REFUSED
    assert reader.read(early, 10.6) is Arrival.NEW


def test_diagnostics_come_by_themselves_although_time_stands_still(ros):
    sim_time = [Parameter("use_sim_time", value=True)]
    for name in ("left", "right"):  # two arms are told apart
        node = Node("arm", context=ros.context, namespace=name, parameter_overrides=sim_time)
        reader = make_reader()
        reader.read(joint_state(["x"], 2 * SECOND, [0.0], [0.0]), 10.0)
        values = {
            "arm": name,
            "number": 1.5,
            "array": np.array([1.0, -0.25]),
            "refused": reader.refused,
            "none": make_reader().refused,
        }
        Diagnostics(ros.add(node), lambda told=values: (DiagnosticStatus.WARN, "so so", told))
    for name in ("left", "right"):
        ros.wait_until(lambda arm=name: ros.reported(f"{arm}/arm", "arm"), "diagnostics")
        assert ros.diagnostics[f"{name}/arm"] == {
            "arm": name,
            "number": "1.5",
            "array": "1 -0.25",
            "refused": "missing joint: 1;",
            "none": "none",
            "level": DiagnosticStatus.WARN,
            "message": "so so",
        }
