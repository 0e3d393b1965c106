# SPDX-License-Identifier: Apache-2.0
"""Two hands of a simulated robot with friction and wrong masses, and one integral for both."""

from __future__ import annotations

import numpy as np
import pytest
import two_hands
from direct import DirectLoop

pytestmark = pytest.mark.long


def test_a_pushed_elbow_yields_and_both_hands_stay(monkeypatch):
    monkeypatch.setattr(two_hands, "HELD", 1.0)
    direction, _ = two_hands.weakest_direction(DirectLoop(two_hands.ROBOT), two_hands.ELBOW)
    push = two_hands.Push("elbow", two_hands.ELBOW, two_hands.ELBOW_FORCE * direction, 0.0)
    moved = {}
    for mode in two_hands.MODES.values():
        run = two_hands.play(mode, (push,))
        assert run.kept
        assert run.budgets.max() < 1.0 + 1e-9
        assert run.errors.max() < 3e-3
        moved[mode] = np.abs(run.q - run.q[0]).max()
    assert moved["task"] > 0.3
    assert moved["task"] > 5.0 * moved["joints"]
