# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from rclpy.node import Node
from rclpy.parameter import Parameter

from viability_bounds_pkg.plausible import JUMP, PlausibilityCheck
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import Arrival, JointStateReader
from viability_bounds_pkg.ros.runtime import set_stamp, stamp_to_ns
from viability_bounds_pkg.testing.ros_harness import joint_state

JOINTS = ("a", "b", "c")
Q, V = [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]
SECOND = 1_000_000_000
NONE = np.zeros(3)


def make_reader():
    reader = JointStateReader(JOINTS, reset_after=0.5)
    assert reader.read(joint_state(JOINTS, SECOND, Q, V), now=10.0) is Arrival.NEW
    return reader


def holds(reader, q, v, stamp):
    np.testing.assert_array_equal(reader.q, q)
    np.testing.assert_array_equal(reader.v, v)
    assert reader.stamp == stamp


def test_values_arrive_in_the_order_of_the_joints():
    holds(make_reader(), Q, V, SECOND)


def test_names_may_come_in_any_order_and_with_others():
    reader = make_reader()
    message = joint_state(
        ["x", "c", "a", "y", "b"], 2 * SECOND, [9.0, 3.0, 1.0, 9.0, 2.0], [8, 6, 4, 8, 5]
    )
    assert reader.read(message, 10.01) is Arrival.NEW
    holds(reader, [1.0, 2.0, 3.0], [4.0, 5.0, 6.0], 2 * SECOND)
    # And back: the order may change from message to message.
    assert reader.read(joint_state(JOINTS, 3 * SECOND, Q, V), 10.02) is Arrival.NEW
    holds(reader, Q, V, 3 * SECOND)


def test_what_other_joints_do_does_not_matter():
    reader = make_reader()
    message = joint_state(
        ["x", *JOINTS], 2 * SECOND, [math.nan, 1.0, 2.0, 3.0], [math.inf, 4.0, 5.0, 6.0]
    )
    assert reader.read(message, 10.01) is Arrival.NEW
    holds(reader, [1.0, 2.0, 3.0], [4.0, 5.0, 6.0], 2 * SECOND)


@pytest.mark.parametrize("stamp", [0, -1, -5 * SECOND])
def test_a_stamp_of_zero_or_before_is_none(stamp):
    warnings = []
    reader = JointStateReader(JOINTS, warn=warnings.append)
    assert reader.read(joint_state(JOINTS, stamp, Q, V), 10.0) is Arrival.REFUSED
    assert reader.refused == {"no stamp": 1}
    what = "zero" if stamp == 0 else "before zero"
    assert warnings == [f"joint_states refused: no stamp: header.stamp is {what}"]


@given(order=st.permutations(range(6)), data=st.data())
def test_any_order_of_any_joints(order, data):
    names = [*JOINTS, "x", "y", "z"]
    number = st.floats(-1e6, 1e6)
    q = data.draw(st.lists(number, min_size=6, max_size=6))
    v = data.draw(st.lists(number, min_size=6, max_size=6))
    reader = JointStateReader(JOINTS)
    message = joint_state(
        [names[i] for i in order], 5, [q[i] for i in order], [v[i] for i in order]
    )
    assert reader.read(message, 0.0) is Arrival.NEW
    holds(reader, q[:3], v[:3], 5)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (joint_state(JOINTS, 2 * SECOND, [0.0, math.nan, 0.0], V), "not finite"),
        (joint_state(JOINTS, 2 * SECOND, Q, [0.0, 0.0, -math.inf]), "not finite"),
        (joint_state(JOINTS, 2 * SECOND, Q, [math.inf, 0.0, -math.inf]), "not finite"),
        (joint_state(JOINTS, 2 * SECOND, Q[:2], V), "wrong size"),
        (joint_state(JOINTS, 2 * SECOND, Q, V[:2]), "wrong size"),
        (joint_state(JOINTS, 2 * SECOND, Q, []), "wrong size"),
        (joint_state(JOINTS, 2 * SECOND, [*Q, 0.0], [*V, 0.0]), "wrong size"),
        (joint_state([*JOINTS, "x"], 2 * SECOND, Q, V), "wrong size"),
        (joint_state(["a", "b", "x"], 2 * SECOND, Q, V), "missing joint"),
        (joint_state(["a", "b"], 2 * SECOND, Q[:2], V[:2]), "missing joint"),
        (joint_state([], 2 * SECOND), "missing joint"),
        (joint_state(JOINTS, SECOND - 1, Q, V), "old stamp"),
        (joint_state(JOINTS, 0, Q, V), "no stamp"),
        (joint_state(JOINTS, SECOND, V, V), "other values under the same stamp"),
        (joint_state(JOINTS, SECOND, Q, Q), "other values under the same stamp"),
    ],
)
def test_what_is_refused_is_counted_and_changes_nothing(message, reason):
    reader = make_reader()
    assert reader.read(message, 10.01) is Arrival.REFUSED
    assert reader.refused == {reason: 1}
    holds(reader, Q, V, SECOND)
    assert reader.read(message, 10.02) is Arrival.REFUSED
    assert reader.refused == {reason: 2}
    assert reader.read(joint_state(JOINTS, 3 * SECOND, V, Q), 10.03) is Arrival.NEW
    holds(reader, V, Q, 3 * SECOND)


@pytest.mark.parametrize("names", [[], ["x"]])
def test_a_first_message_without_the_joints_is_refused(names):
    reader = JointStateReader(JOINTS)
    message = joint_state(names, SECOND, [0.0] * len(names), [0.0] * len(names))
    assert reader.read(message, 0.0) is Arrival.REFUSED
    assert reader.q.shape == reader.v.shape == (3,)


def test_the_same_message_again_is_a_repeat():
    reader = make_reader()
    for now in (10.1, 10.2, 100.0):
        assert reader.read(joint_state(JOINTS, SECOND, Q, V), now) is Arrival.REPEATED
    assert not reader.refused


def test_old_stamps_are_taken_again_after_silence():
    reader = make_reader()
    restarted = joint_state(JOINTS, 5, V, Q)
    assert reader.read(restarted, 10.0 + 0.49) is Arrival.REFUSED
    assert reader.read(restarted, 10.0 + 0.51) is Arrival.NEW
    holds(reader, V, Q, 5)
    assert reader.read(joint_state(JOINTS, 6, Q, V), 10.52) is Arrival.NEW


def test_a_source_that_starts_over_at_the_same_stamp_is_taken_after_silence():
    reader = make_reader()
    restarted = joint_state(JOINTS, SECOND, V, Q)
    assert reader.read(restarted, 10.0 + 0.49) is Arrival.REFUSED
    assert reader.read(restarted, 10.0 + 0.51) is Arrival.NEW
    holds(reader, V, Q, SECOND)


def test_one_corrupt_stamp_in_the_future_does_not_lock_the_robot_out():
    reader = make_reader()
    assert reader.read(joint_state(JOINTS, 1000 * SECOND, Q, V), 10.01) is Arrival.NEW
    now, stamp = 10.02, 2 * SECOND
    while reader.read(joint_state(JOINTS, stamp, Q, V), now) is Arrival.REFUSED:
        now, stamp = now + 0.01, stamp + 10_000_000
        assert now < 10.6
    assert now == pytest.approx(10.51, abs=0.011)


def test_impossible_states_are_refused_and_counted_until_they_are_plausible_again():
    limit = np.full(3, 2.5)
    check = PlausibilityCheck(-limit, limit, limit, 0.01, NONE, NONE)
    warnings = []
    reader = JointStateReader(JOINTS, warn=warnings.append, check=check)

    def arrives(k, q):
        return reader.read(joint_state(JOINTS, k * SECOND // 100, q, NONE), 0.01 * k)

    assert arrives(1, Q) is Arrival.NEW
    assert arrives(2, V) is Arrival.REFUSED
    assert arrives(3, Q) is Arrival.NEW
    assert reader.refused == {"impossible": 1}
    assert warnings == [f"joint_states refused: impossible: {JUMP}"]


def test_a_robot_that_waits_for_the_answer_to_an_impossible_state_is_answered_after_a_while():
    limit = np.full(3, 2.5)
    check = PlausibilityCheck(-limit, limit, limit, 0.01, NONE, NONE)
    reader = JointStateReader(JOINTS, reset_after=0.5, check=check)
    assert reader.read(joint_state(JOINTS, SECOND, Q, NONE), 10.0) is Arrival.NEW
    jumped = joint_state(JOINTS, SECOND + 10_000_000, V, NONE)
    for now in (10.01, 10.05, 10.49):
        assert reader.read(jumped, now) is Arrival.REFUSED
    assert reader.read(jumped, 10.52) is Arrival.NEW


def test_what_is_not_taken_does_not_count_as_heard():
    reader = JointStateReader(JOINTS, reset_after=1.0)
    late, early = joint_state(JOINTS, 100, Q, V), joint_state(JOINTS, 50, Q, V)
    assert reader.read(joint_state(JOINTS[:2], 100, Q[:2], V[:2]), 0.0) is Arrival.REFUSED
    assert reader.read(early, 0.1) is Arrival.NEW
    assert reader.read(late, 0.2) is Arrival.NEW
    assert reader.read(early, 0.3) is Arrival.REFUSED
    assert reader.read(early, 1.1) is Arrival.REFUSED  # a refusal is no sign of life either
    assert reader.read(early, 1.2) is Arrival.NEW


@pytest.mark.parametrize("nanoseconds", [0, 999_999_999, SECOND, 1_795_235_306_814_914_975])
def test_stamps_survive_the_round_trip(nanoseconds):
    message = joint_state([], 0)
    set_stamp(message.header.stamp, nanoseconds)
    assert stamp_to_ns(message.header.stamp) == nanoseconds
    assert message.header.stamp.nanosec < 1_000_000_000


def test_diagnostics_come_by_themselves_although_time_stands_still(ros):
    node = ros.add(
        Node(
            "watched",
            context=ros.context,
            parameter_overrides=[Parameter("use_sim_time", value=True)],
        )
    )
    reader = make_reader()
    reader.read(joint_state(["x"], 2 * SECOND, [0.0], [0.0]), 10.0)
    values = {
        "number": 1.5,
        "array": np.array([1.0, -0.25]),
        "refused": reader.refused,
        "none": JointStateReader(JOINTS).refused,
        "text": "fine",
    }
    Diagnostics(node, lambda: (DiagnosticStatus.WARN, "so so", values))
    ros.wait_until(lambda: ros.reported("watched", "text"), "diagnostics")
    assert ros.diagnostics["watched"] == {
        "number": "1.5",
        "array": "1 -0.25",
        "refused": "missing joint: 1;",
        "none": "none",
        "text": "fine",
        "level": DiagnosticStatus.WARN,
        "message": "so so",
    }


def test_diagnostics_of_two_arms_are_told_apart(ros):
    for namespace in ("left", "right"):
        node = ros.add(Node("arm", context=ros.context, namespace=namespace))
        report = DiagnosticStatus.OK, "", {"arm": namespace}
        Diagnostics(node, lambda report=report: report)
    for namespace in ("left", "right"):
        ros.wait_until(lambda name=f"{namespace}/arm": ros.reported(name, "arm"), namespace)
        assert ros.reported(f"{namespace}/arm", "arm") == namespace
