# SPDX-License-Identifier: Apache-2.0
"""`bench.sh realtime --loads`: limits kept where programs stop; a limit passed is told."""

import importlib
from pathlib import Path

import pytest

from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
def test_a_stack_that_is_paused_keeps_the_limits():
    words = ["realtime", "--loads", "--seconds", "3", "--case", "baxter_left_arm@100"]
    words += ["--load", "pause controller_node"]
    run = run_to_end("bash", ROOT / "scripts" / "bench.sh", *words, timeout=600.0)
    assert run.returncode == 0, run.stdout + run.stderr
    cells = run.stdout.splitlines()[-1].split(" | ")
    assert cells[:2] == ["baxter_left_arm", "pause controller_node"]
    periods, missed = int(cells[2]), int(cells[3])
    assert missed > 0, "no pause had an effect"
    assert periods > 20  # of 300: the machine may be busy, too
    assert cells[-1] == "kept"


@pytest.mark.parametrize(
    ("level", "beyond", "told"),
    [
        (b"\x00", "0 0", "kept"),
        (b"\x02", "0 0.01", "**passed**: position by 0.01 rad"),
        (b"\x02", "0 0", "**passed**: torque"),
    ],
)
def test_a_row_tells_which_limit_was_passed(monkeypatch, level, beyond, told):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    bench = importlib.import_module("bench_realtime")
    keys = ("periods", "deadline_misses", "late_periods", "braked_periods")
    found = dict.fromkeys(keys, "1") | {
        "level": level,
        "position_violation_rad": beyond,
        "velocity_violation_rad_s": "0 0",
        "lower_clearance_rad": "0.1 0.2",
        "upper_clearance_rad": "0.3 0.05",
    }
    cells = bench.load_row("panda", "idle", found)
    assert len(cells) == len(bench.LOAD_HEADS)
    assert cells[-2:] == ("0.05", told)
