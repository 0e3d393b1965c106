# SPDX-License-Identifier: Apache-2.0
"""The long comparison of `exactness.py` (reproduction), in short, and that it can fail."""

import json

import exactness
import numpy as np
import pytest
from joint_cases import CASES, condition_holds

NAMES = ("figure 3", "narrow")


@pytest.fixture(scope="module")
def outcomes():
    joints = exactness.named_joints({name: CASES[name] for name in NAMES}, seed=1)
    assert [joint.holds for joint in joints] == [True, False]
    works = (
        lambda joint: exactness.against_brute_force(30, joint),
        lambda joint: exactness.discrete_kernel(30, joint),
        lambda joint: exactness.in_motion(5, joint),
        exactness.from_outside,
    )
    return [exactness.rows_of([(joint, work(joint)) for joint in joints]) for work in works]


def test_claims_hold(outcomes):
    assert exactness.failures(*outcomes) == []
    compared, kernel, moved, outside = outcomes
    for name in NAMES:
        row = (name, name == "figure 3")
        assert compared[row].compared > 5
        assert kernel[row].compared > 5
        assert moved[row].joint_steps == 5 * exactness.STEPS * len(exactness.POLICIES)
        assert outside[row].motions == exactness.MOTIONS_OUTSIDE * len(exactness.POLICIES)


@pytest.mark.parametrize(
    ("which", "wrong"),
    [
        (0, {"difference": 1.1e-6}),
        (0, {"misjudged": 1}),
        (0, {"undecided": 1}),
        (1, {"difference": 1.1e-6}),
        (2, {"position": 1.1e-9}),
        (2, {"speed": 1.1e-9}),
        (2, {"lost": 1}),
        (3, {"stray": 1}),
        (3, {"again": 1.1e-9}),
        (3, {"speed": 1.1e-9}),
        (3, {"beyond": 1.1e-9}),
    ],
)
def test_a_claim_that_does_not_hold_is_named(outcomes, which, wrong):
    changed = [dict(part) for part in outcomes]
    row = ("figure 3", True)
    changed[which][row] = changed[which][row]._replace(**wrong)
    (message,) = exactness.failures(*changed)
    assert message.startswith("figure 3: ") and next(iter(wrong)) in message


@pytest.mark.parametrize("wrong", [{"excess": 1.1e-6}, {"unsafe": 1}])
def test_bounds_that_allow_too_much_are_named_where_the_condition_fails(outcomes, wrong):
    row = ("narrow", False)
    changed = outcomes[0] | {row: outcomes[0][row]._replace(**wrong)}
    (message,) = exactness.failures(changed, *outcomes[1:])
    assert message.startswith("narrow: ")


def test_random_joints_are_of_the_kind_asked_for():
    for holds in (True, False):
        joints = exactness.random_joints(holds, 40, np.random.default_rng(0))
        for joint in joints:
            assert condition_holds(joint.case) == joint.holds == holds
        assert len({joint.seed for joint in joints}) == 40
        cases = np.array([joint.case for joint in joints])
        assert np.isinf(cases[:, :2]).any(axis=0).all() and np.isfinite(cases[:, 2:]).all()


def test_metrics_are_plain_json(outcomes, capsys):
    for rows in outcomes:
        exactness.table("title", list(next(iter(rows.values()))._fields), rows)
        assert json.loads(json.dumps(exactness.as_metrics(rows), allow_nan=False))
    assert capsys.readouterr().out.count("all ") == 2 * len(outcomes)
