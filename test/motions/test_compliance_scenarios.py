# SPDX-License-Identifier: Apache-2.0
"""TALOS with friction, stiff at the hand and free in the null space: pushes and poles.

Shorter runs of what `scripts/reproduce.sh paper1-compliance` plays.
"""

import compliance_curve as curve
import compliance_push as pushing
import numpy as np
import pytest

pytestmark = pytest.mark.long

LACKING, COMPLIANT = pushing.MODES


@pytest.fixture(scope="module")
def pushed():
    """Pushes along z at the hand, then at the elbow, there and back."""
    return {
        name: pushing.push(changed, axes="z", held=0.7) for name, changed in pushing.MODES.items()
    }


def test_only_the_integral_action_differs():
    assert pushing.MODES[LACKING].keys() == pushing.MODES[COMPLIANT].keys() == {"integral_action"}


def test_the_elbow_gives_way_and_the_hand_stays(pushed):
    found = {name: pushing.judge(run) for name, run in pushed.items()}
    moved = {name: each["witness_motion_rad"] for name, each in found.items()}
    assert moved[COMPLIANT] > 0.1
    assert moved[COMPLIANT] > 3.0 * moved[LACKING]
    assert found[COMPLIANT]["hand_m"] < 5e-3
    assert found[COMPLIANT]["hand_rad"] < np.radians(1.0)
    assert all(pushing.within_limits(run.loop) for run in pushed.values())


def test_the_hand_is_as_stiff(pushed):
    found = {name: pushing.judge(run) for name, run in pushed.items()}
    assert found[COMPLIANT]["steady_m"] <= found[LACKING]["steady_m"]
    assert found[COMPLIANT]["largest_m"] <= found[LACKING]["largest_m"]


def test_unknown_poles_are_given_way_to_and_the_curve_is_drawn():
    runs = {
        name: curve.draw(changed, curve.POLES, 1, 6.0) for name, changed in pushing.MODES.items()
    }
    found = {name: curve.judge(run) for name, run in runs.items()}
    # Both are hit, by their links; the hand and what carries it never are.
    for run in runs.values():
        assert run.touched
        assert run.touched <= {f"arm_left_{k}_link" for k in range(1, 6)}
    assert found[COMPLIANT]["hand_m"] < 0.02
    assert found[COMPLIANT]["within_limits"]
    assert found[COMPLIANT]["force_n"] < found[LACKING]["force_n"]
    assert found[COMPLIANT]["impulse_n_s"] < found[LACKING]["impulse_n_s"]
