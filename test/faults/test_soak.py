# SPDX-License-Identifier: Apache-2.0
"""`scripts/soak.sh`: a short run, its end by Ctrl-C, and what it makes of broken promises."""

import json
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from soak_plan import BETWEEN, slots, timeline
from soak_record import Episode, Memory, Record

from sim_bridge.faults.timeline import load_timeline
from sim_bridge.nodes.fault_node import STREAMS
from viability_bounds_pkg.testing.executables import as_child, run_to_end

ROOT = Path(__file__).resolve().parents[2]
SOAK = ["bash", ROOT / "scripts" / "soak.sh", "--rate", "100", "--every", "2"]


@pytest.mark.long
def test_a_soak_ends_by_itself_with_a_report_of_all_that_happened(tmp_path):
    run = run_to_end(*SOAK, "--minutes", "0.15", "--out", tmp_path)
    found = json.loads((tmp_path / "metrics.json").read_text())
    # On a busy machine the arm may go on late, which is said.
    assert not [each for each in found["wrong"] if not each.startswith("no motion after")]
    assert run.returncode == (0 if found["kept"] else 1), run.stdout + run.stderr
    assert found["faults"]
    assert sum(found["goals"].values()) >= 2
    assert found["robot_time_s"] > 3.0
    assert (tmp_path / "report.md").read_text() in run.stdout


@pytest.mark.long
def test_ctrl_c_ends_it_with_its_report(tmp_path):
    with subprocess.Popen(
        [*SOAK, "--minutes", "60", "--out", tmp_path],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    ) as run:
        try:
            next(line for line in run.stdout if " min  goals " in line)
            run.send_signal(signal.SIGINT)
            out = run.stdout.read()
            assert run.wait(60.0) == 0, out
        finally:
            run.kill()
    assert "**all kept**" in out
    assert json.loads((tmp_path / "metrics.json").read_text())["elapsed_s"] < 60.0


def test_each_fault_comes_about_as_often_as_the_others_and_the_file_can_be_read(tmp_path):
    others = ("a stands still",)
    planned = slots(np.random.default_rng(0), 3 * (len(BETWEEN) + 1), others)
    names = [each.name for each in planned]
    assert {names.count(name) for name in (*BETWEEN, *others)} == {3}
    path = tmp_path / "faults.yaml"
    path.write_text(timeline(planned, 8.0))
    faults = load_timeline(str(path), tuple(STREAMS)).faults
    assert sum(map(len, faults.values())) == 3 * len(BETWEEN)
    path.write_text(timeline([], 8.0))
    assert not any(load_timeline(str(path), tuple(STREAMS)).faults.values())


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ({}, None),
        ({"position": 1e-6}, "a limit was passed"),
        ({"speed": 1e-6}, "a limit was passed"),
        ({"torque": 1.001}, "a limit was passed"),
        ({"torque": float("nan")}, "a limit was passed"),
        ({"robot": {}}, "the robot never reported"),
        ({"episodes": [Episode("states lost", 1.0, 2.0)]}, "no motion after: states lost"),
        (
            {"episodes": [Episode("states lost", 1.0, 2.0, again=0.1)]},
            "no motion after: states lost",
        ),
        ({"episodes": [Episode("states lost", 1.0, 2.0, again=0.1, obeyed=True)]}, None),
        ({"ended": ["bounds_node"]}, "ended by themselves: bounds_node"),
    ],
)
def test_what_was_promised_and_did_not_happen_is_said(broken, said):
    record = Record(robot={"periods": "1"})
    for name, value in broken.items():
        setattr(record, name, value)
    assert record.wrong == ([] if said is None else [said])


@pytest.mark.parametrize(("growth", "told"), [(0.0, False), (100.0, True)])
def test_memory_that_grows_is_told_in_runs_that_are_long_enough(growth, told):
    memory = Memory(1, 0.0)
    memory.samples = [(t, 100.0 + growth * t / 3600.0) for t in np.arange(0.0, 900.0, 5.0)]
    assert memory.slope == pytest.approx(growth, abs=1e-6)
    record = Record(robot={"periods": "1"}, memory={"x": memory})
    assert record.wrong == (["memory of x grows"] if told else [])
    memory.samples = memory.samples[:100]
    assert not record.wrong
