# SPDX-License-Identifier: Apache-2.0
"""Odd messages and files for the real nodes, some of those of scripts/fuzz.sh."""

import numpy as np
import pytest
from fuzzing import files, programs
from fuzzing.edit import Edit
from fuzzing.file_edits import odd_file
from fuzzing.machine import Machine
from fuzzing.message_edits import KINDS as EDITS
from fuzzing.message_edits import edited
from fuzzing.stack import GOALS, KINDS, STREAMS, TOPICS, WORLD, running
from fuzzing.tally import TAKEN, ClaimBroken, Tally
from hypothesis import HealthCheck, given, settings
from hypothesis.stateful import run_state_machine_as_test

from torque_safety_controller.safety.torque_limiter import TorqueLimiter
from viability_bounds_pkg.ros.messages import JointStateReader, Verdict

FEW = settings(
    max_examples=3, stateful_step_count=8, suppress_health_check=list(HealthCheck), database=None
)


def test_claims_hold_through_random_sequences():
    tally = Tally()
    run_state_machine_as_test(type("Few", (Machine,), {"tally": tally}), settings=FEW)
    assert sum(tally.sent.values()) > 50
    assert tally.facts["checks with limits"] > 5
    assert tally.facts["recoveries"] >= 3


@pytest.mark.long
def test_odd_files_are_refused_in_a_line_or_keep_the_claims():
    tally = Tally()

    @settings(max_examples=25, suppress_health_check=list(HealthCheck), database=None)
    @given(files.CASES)
    def some(case):
        files.try_file(case, tally)

    some()
    taken = sum(count for (_, what), count in tally.outcomes.items() if what == TAKEN)
    assert 0 < taken < sum(tally.sent.values())


def test_an_executable_refuses_an_odd_file_in_a_line():
    case = "robot", 0, "bounds_node", (Edit("value", 1, "1e-3"),)
    files.try_file(case, Tally(), really=True)


def test_all_topics_that_nodes_hear_are_fuzzed():
    with running("panda, imperfect", False, Tally()) as stack:
        heard = {each.topic_name for node in stack.nodes.values() for each in node.subscriptions}
    fuzzed = {topic if topic.startswith("/") else f"/{topic}" for topic in TOPICS}
    # Compared with the description at the start, and told where it differs; nothing obeys it.
    assert heard == fuzzed | {"/robot_description"}


@pytest.mark.parametrize("through", [False, True], ids=["directly", "by DDS"])
def test_what_becomes_of_messages(through):
    tally = Tally()
    with running("panda", True, tally) as stack:
        stack.run(3)
        for topic, changes, outcome in (
            ("target_posture", (), TAKEN),
            ("target_posture", (Edit("number", 0, np.nan),), "refused"),
            (
                "joint_states",
                (Edit("number", 0, np.inf), Edit("leap", 0, 1)),
                "refused: not finite",
            ),
            ("joint_commands", (Edit("leap", 0, -1),), "refused: not for this period"),
        ):
            before = tally.outcomes[topic, outcome]
            stack.inject(topic, changes, 1, False, through)
            assert tally.outcomes[topic, outcome] > before, (topic, changes, tally.outcomes)
        stack.check()
        stack.recover()
    assert tally.facts["through DDS"] == 4 * through


@pytest.mark.parametrize(
    ("where", "fault", "says"),
    [
        ("TorqueLimiter.limited", lambda self, tau: 10.0 * tau, "beyond torque_max"),
        ("TorqueLimiter.limited", lambda self, tau: tau * np.nan, "not finite"),
        ("JointStateReader._refuse", lambda *_: Verdict.REFUSED, "without counting it"),
    ],
)
def test_claims_that_are_broken_are_told(monkeypatch, where, fault, says):
    kind, name = where.split(".")
    of = {"TorqueLimiter": TorqueLimiter, "JointStateReader": JointStateReader}[kind]
    monkeypatch.setattr(of, name, fault)
    with running("panda", False, Tally()) as stack, pytest.raises(ClaimBroken, match=says):
        stack.run(2)
        stack.good_goal(3)
        for _ in range(50):
            stack.inject("joint_states", (Edit("number", 0, np.nan),), 0, False, False)
            stack.run(2)


def test_refusals_of_several_lines_or_of_nothing_are_told():
    for lines in (["error: one", "error: two"], ["error: something is wrong"], []):
        with pytest.raises(ClaimBroken):
            programs.check_refusal(
                programs.Ended(1, lines, 0), frozenset({"rate_hz"}), ("a.yaml",)
            )
    fine = programs.Ended(1, ["error: parameter 'rate_hz' is -1; allowed: a number > 0"], 0)
    programs.check_refusal(fine, frozenset(), ())


def test_each_edit_changes_messages_of_each_type():
    with running("panda", False, Tally()) as stack:
        stack.run(2)
        messages = [stack._base(name, 3, False) for name in (*STREAMS, *GOALS, *WORLD)]
    values = {"scale": 10.0, "size": 2, "text": "odd", "leap": 10**9, "stamp": (7, 8), "whole": 7}
    for kind in EDITS:
        changed = [
            edited(message, [Edit(kind, where, values.get(kind, 5.0 if kind == "number" else 0))])
            != message
            for message in messages
            for where in range(4)
        ]
        assert any(changed), kind


def test_each_edit_changes_a_file():
    document = {"a": {"b": [1.0, 2.0], "c": "x"}, "d": 3}
    plain = odd_file(document, ()).data
    for edit in (
        Edit("value", 1, "odd"),
        Edit("number", 0, -1.0),
        Edit("scale", 0, 2.0),
        Edit("length", 0, 1),
        *(Edit(kind, 1) for kind in ("drop", "rename", "nest", "add", "cut")),
        Edit("double", 0),
        Edit("swap", 0, 1),
        Edit("line", 1, "twice"),
        Edit("insert", 3, "{"),
        Edit("byte", 3, 0),
    ):
        assert odd_file(document, (edit,)).data != plain, edit


def test_nodes_of_all_kinds_take_part():
    assert set(KINDS) == {
        "bullet_node",
        "bounds_node",
        "estimator_node",
        "controller_node",
        "scenario_node",
        "fault_node",
    }
