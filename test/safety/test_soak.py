# SPDX-License-Identifier: Apache-2.0
"""`reproduce.sh soak`: a short run, and what it makes of limits passed and arms that stand."""

import math
from pathlib import Path

import pytest
import soak
from soak import FAULTS, SOON, Round

from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
def test_faults_pass_no_limit_and_the_arm_goes_on():
    words = ["soak", "--robot", "baxter_left_arm", "--rounds", "1"]
    run = run_to_end("bash", ROOT / "scripts" / "reproduce.sh", *words, timeout=None)
    assert run.returncode == 0, run.stdout + run.stderr
    assert all(f"{name:32}kept" in run.stdout for name in FAULTS)


@pytest.mark.parametrize(
    ("passed", "again", "code"),
    [
        ("", 0.5, 0),
        ("position_violation_rad 0.01", 0.5, 1),
        ("", SOON + 0.1, 1),
        ("", math.inf, 1),
    ],
)
def test_it_fails_where_a_limit_was_passed_or_the_arm_stands(monkeypatch, passed, again, code):
    class Played:
        def __init__(self, *_):
            pass

        def start(self, *_):
            pass

        begin = close = start

        def run(self, name):
            return Round(name, passed, again)

    monkeypatch.setattr(soak, "Soak", Played)
    assert soak.main(["--rounds", "1"]) == code
