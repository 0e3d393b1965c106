# SPDX-License-Identifier: Apache-2.0
"""What each fault does to messages, and the file that they are read from."""

from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sim_bridge.faults.fault import FAULTS
from sim_bridge.faults.faulty_stream import FaultyStream
from sim_bridge.faults.message_values import stamp_of
from sim_bridge.faults.timeline import TimelineError, load_timeline
from viability_bounds_pkg.testing.ros_harness import joint_state

EXAMPLES = Path(__file__).resolve().parents[2] / "config" / "faults"
TOPICS = ("joint_states", "joint_commands", "acceleration_limits", "ft_wrench")
JOINTS = ["a", "b", "c"]
MS = 1_000_000


def state(k, **more):
    q = [0.1, 0.2, 0.3]
    return joint_state(JOINTS, k * MS, more.get("q", q), more.get("v", [1.0, 2.0, 3.0]))


def faulty(kind, seed=0, start=1e-3, end=3e-3, **settings):
    """A stream with one fault, from the second to the third of messages 1 ms apart."""
    return FaultyStream([FAULTS[kind](start=start, end=end, **settings)], seed)


def play(stream, messages):
    """What is sent, in its order, of messages with stamps in ms."""
    sent = []
    for message in messages:
        sent += stream.at(1e-9 * stamp_of(message))
        sent += stream.passages(message)
    return sent


def stamps(sent):
    return [stamp_of(each.message) // MS for each in sent]


@pytest.mark.parametrize(
    ("kind", "settings", "expected"),
    [
        ("drop", {}, [0, 3, 4]),
        ("drop", {"probability": 0.0}, [0, 1, 2, 3, 4]),
        ("duplicate", {}, [0, 1, 1, 2, 2, 3, 4]),
        ("reorder", {}, [0, 2, 1, 3, 4]),
        ("burst", {}, [0, 1, 2, 3, 4]),
        ("stamp", {"offset": 0.01}, [0, 11, 12, 3, 4]),
        ("stamp", {"offset": -1.0}, [0, 0, 0, 3, 4]),
    ],
)
def test_which_messages_come_and_when(kind, settings, expected):
    sent = play(faulty(kind, **settings), [state(k) for k in range(5)])
    assert stamps(sent) == expected
    assert not any(each.delay or each.rival for each in sent)


def test_a_burst_comes_when_it_ends_before_what_follows():
    stream = faulty("burst")
    assert stamps(play(stream, [state(k) for k in range(3)])) == [0]
    assert stream.acting == ["burst"]
    assert stamps(stream.at(3e-3)) == [1, 2]
    assert stream.at(4e-3) == [] and stream.acting == []


def test_what_is_held_at_the_end_is_not_lost():
    sent = play(faulty("reorder", end=2e-3), [state(k) for k in range(4)])
    assert sorted(stamps(sent)) == [0, 1, 2, 3]


def test_delays_lie_between_delay_and_delay_with_jitter():
    sent = play(
        faulty("delay", start=0.0, end=1.0, delay=0.01, jitter=0.02), map(state, range(200))
    )
    delays = np.array([each.delay for each in sent])
    assert delays.min() >= 0.01 and delays.max() <= 0.03
    assert np.ptp(delays) > 0.015


@pytest.mark.parametrize(
    ("kind", "settings", "q", "v"),
    [
        ("bias", {"offset": 1.0}, [1.1, 1.2, 1.3], [2.0, 3.0, 4.0]),
        ("bias", {"offset": 1.0, "field": "position"}, [1.1, 1.2, 1.3], [1.0, 2.0, 3.0]),
        ("bias", {"offset": 1.0, "joints": ("b",)}, [0.1, 1.2, 0.3], [1.0, 3.0, 3.0]),
        ("scale", {"factor": 10.0}, [1.0, 2.0, 3.0], [10.0, 20.0, 30.0]),
        ("swap", {"joints": ("a", "c")}, [0.3, 0.2, 0.1], [3.0, 2.0, 1.0]),
        ("corrupt", {"field": "velocity", "how": "inf"}, [0.1, 0.2, 0.3], [np.inf] * 3),
        ("corrupt", {"how": "short"}, [0.1, 0.2], [1.0, 2.0]),
    ],
)
def test_what_becomes_of_numbers(kind, settings, q, v):
    sent = play(faulty(kind, **settings), [state(0), state(1)])
    assert list(sent[0].message.position) == [0.1, 0.2, 0.3]
    assert np.allclose(sent[1].message.position, q) and np.allclose(sent[1].message.velocity, v)


def test_frozen_numbers_are_those_of_the_beginning_each_time():
    fault = FAULTS["freeze"](start=1e-3, end=3e-3, field="position")
    stream = FaultyStream([fault], 0)
    sent = play(stream, [state(k, q=[0.1 * k] * 3, v=[float(k)] * 3) for k in range(5)])
    assert np.allclose([each.message.position[0] for each in sent], [0.0, 0.1, 0.1, 0.3, 0.4])
    assert [each.message.velocity[0] for each in sent] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert stamps(sent) == [0, 1, 2, 3, 4]
    again = play(stream, [state(k, q=[1.0 * k] * 3) for k in range(3)])
    assert again[1].message.position[0] == 1.0


def test_noise_has_its_deviation_and_repeats_with_the_seed():
    def play_one(seed):
        stream = faulty("noise", seed, 0.0, 10.0, field="position", deviation=0.5)
        return np.array([each.message.position for each in play(stream, map(state, range(1000)))])

    one = play_one(1) - [0.1, 0.2, 0.3]
    assert abs(one.std() - 0.5) < 0.02 and abs(one.mean()) < 0.03
    assert np.array_equal(play_one(1), play_one(1)) and not np.array_equal(
        play_one(1), play_one(2)
    )


def test_other_names_of_joints_and_frames():
    sent = play(faulty("corrupt", how="names"), [state(0), state(1)])
    assert list(sent[1].message.name) == ["a_", "b_", "c_"]
    wrench = WrenchStamped()
    wrench.header.frame_id = "hand"
    stream = faulty("corrupt", start=0.0, how="names")
    assert play(stream, [wrench])[0].message.header.frame_id == "hand_"


def test_a_rival_sends_each_message_again_and_leaves_the_first_as_it_is():
    first, other = play(faulty("rival", start=0.0, offset=2.0), [state(0)])
    assert (first.rival, other.rival) == (False, True)
    assert list(first.message.position) == [0.1, 0.2, 0.3]
    assert np.allclose(other.message.position, [2.1, 2.2, 2.3])


def test_limits_and_wrenches_have_numbers_too():
    limits = JointTrajectory(joint_names=JOINTS)
    limits.points = [JointTrajectoryPoint(accelerations=[float(k)] * 3) for k in (-1, 1)]
    (sent,) = play(faulty("bias", start=0.0, offset=1.0, joints=("b",)), [limits])
    assert [list(point.accelerations) for point in sent.message.points] == [[-1, 0, -1], [1, 2, 1]]
    wrench = WrenchStamped()
    (sent,) = play(faulty("bias", start=0.0, offset=1.0), [wrench])
    assert (sent.message.wrench.force.z, sent.message.wrench.torque.x) == (1.0, 1.0)


@given(st.data())
def test_faults_one_after_the_other_lose_nothing_that_none_drops(data):
    kinds = ("delay", "reorder", "burst", "freeze", "duplicate")
    faults = []
    for kind in data.draw(st.lists(st.sampled_from(kinds), max_size=4)):
        start = 1e-3 * data.draw(st.integers(0, 20))
        faults.append(FAULTS[kind](start=start, end=start + 1e-3 * data.draw(st.integers(1, 20))))
    stream = FaultyStream(faults, data.draw(st.integers(0, 99)))
    sent = play(stream, map(state, range(20))) + stream.at(1.0)
    assert set(stamps(sent)) == set(range(20))


def load(directory, text):
    path = directory / "faults.yaml"
    path.write_text(text)
    return load_timeline(path, TOPICS)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_files_load(path):
    assert any(load_timeline(path, TOPICS).faults.values())


def test_faults_act_in_the_order_of_the_file(tmp_path):
    timeline = load(
        tmp_path,
        """
topics: [joint_states, joint_commands]
faults:
  - {time: 2, duration: 0.5, topic: joint_states, scale: {factor: 2}}
  - {time: 1, duration: 0.5, topic: joint_states, bias: {offset: 1, joints: [a]}}
""",
    )
    scale, bias = timeline.faults["joint_states"]
    assert (scale.start, scale.end, scale.factor) == (2.0, 2.5, 2.0)
    assert (bias.offset, bias.joints, bias.field) == (1.0, ("a",), "")
    assert timeline.faults["joint_commands"] == ()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[]", "the file is []; allowed: fields and their values"),
        ("{}", "topics is None; allowed: a list of topics"),
        ("topics: [joint_state]", "did you mean 'joint_states'?"),
        ("{topics: [ft_wrench], faults: 3}", "faults is 3; allowed: a list"),
        ("{topics: [ft_wrench], fault: []}", "the file has fault; allowed: topics, faults"),
        ("{topics: [ft_wrench], faults: [7]}", "faults[0] is 7"),
    ],
)
def test_a_wrong_file_says_what_is_wrong(tmp_path, text, says):
    with pytest.raises(TimelineError) as error:
        load(tmp_path, text)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("topic: joint_commands, drop: ", "faults[0].topic is 'joint_commands'; allowed: one of"),
        ("topic: {a: 1}, drop: ", "faults[0].topic is {'a': 1}; allowed: one of"),
        ("topic: joint_states", "allowed: exactly one of drop, delay"),
        ("topic: joint_states, drop: , burst: ", "has drop and burst"),
        (
            "topic: joint_states, drop: {share: 1}",
            "faults[0].drop has share; allowed: probability",
        ),
        ("topic: joint_states, drop: {probability: 2}", "is 2; allowed: a number from 0 to 1"),
        ("topic: joint_states, bias: ", "faults[0].bias.offset is None; allowed: a finite number"),
        ("topic: joint_states, bias: {offset: 1, field: q}", "allowed: one of position, velocity"),
        ("topic: joint_states, noise: {deviation: -1}", "allowed: a finite number > 0"),
        ("topic: joint_states, swap: {joints: [a, a]}", "allowed: the names of two joints"),
        ("topic: joint_states, freeze: {joints: []}", "allowed: names of joints"),
        ("topic: joint_states, corrupt: {how: 1}", "allowed: one of nan, inf, huge, short, names"),
        ("topic: joint_states, stamp: {offset: .nan}", "allowed: a finite number"),
    ],
)
def test_a_wrong_fault_says_what_is_wrong(tmp_path, entry, says):
    with pytest.raises(TimelineError) as error:
        load(
            tmp_path,
            f"topics: [joint_states]\nfaults:\n  - {{time: 1, duration: 1, {entry}}}\n",
        )
    assert says in str(error.value)


@pytest.mark.parametrize("field", ["time: -1, duration: 1", "time: 1, duration: 0", "time: 1"])
def test_times_are_checked(tmp_path, field):
    with pytest.raises(TimelineError, match="allowed: a finite number"):
        load(
            tmp_path,
            f"topics: [joint_states]\nfaults:\n  - {{{field}, topic: joint_states, drop: }}\n",
        )
