# SPDX-License-Identifier: Apache-2.0
"""The controller against a second physics engine: limits at each step of MuJoCo."""

import runpy
from pathlib import Path

EXAMPLE = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "mujoco_panda.py"))
drive = EXAMPLE["drive"]


def test_limits_are_kept_in_mujoco():
    found = drive("exact", 5.0, 1)
    assert found.driven > 0.99, "the arm was hardly driven"
    assert found.position <= 0.0
    assert found.speed <= 0.0
    assert found.torque <= 0.0
    # The same URDF, read by two programs: else their robots differ.
    assert found.disagreement < 1e-9


def test_naive_bounds_break_them():
    assert drive("naive", 2.0, 1).position > 0.05  # rad
