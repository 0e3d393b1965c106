# SPDX-License-Identifier: Apache-2.0
"""Every example runs, keeps every limit, and says so."""

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ELSEWHERE = {"driver_template"}  # test/stack/test_driver_template.py
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SAYS = {
    "bounds_alone": r"exact bounds 0\.0e\+00, naive bounds [1-9]",
    "chain_of_nodes": r"positions at most 0 rad beyond their\nlimits, speeds 0 rad/s",
    "client": r"joints moved by \[0\.(2|19) .*\nhand moved by .*\none metre higher: it stands \d",
    "controller_without_ros": r"rad, .* rad/s, .* N m inside\njoints at rest on a limit: \['",
    "mujoco_panda": r"largest speed 99\.\d% of its limit.*\n.*\n-\S+ rad, -\S+ rad/s, -",
    "safe_policy": r"with the bounds 4096 of 4096 arms .*\nwithout them 0 of 4096, ",
    "limits_from_urdf": r"torque does not suffice: 0 of 5000",
}


def test_every_example_is_run():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*SAYS, *ELSEWHERE}


def test_the_notebook_runs_cell_by_cell(capfd, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(EXAMPLES)
    (path,) = EXAMPLES.glob("*.ipynb")
    cells = [each for each in json.loads(path.read_text())["cells"] if each["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells)
    names = {"__name__": "__main__"}
    try:
        for cell in cells:
            exec(compile("".join(cell["source"]), f"{path}:{cell['id']}", "exec"), names)
    finally:
        names["stack"].kill()
    recording = names["recording"]
    assert recording.q.shape == recording.v.shape == recording.tau.shape == (len(recording.t), 7)
    assert len(recording.t) > 500
    assert (np.diff(recording.t) > 0.0).all()
    assert recording.q[:, 3].min() < -3.05  # at its limit
    assert "refused it" in capfd.readouterr().out


@pytest.mark.parametrize(
    "name",
    # The notebook has the client, too.
    [pytest.param(name, marks=[pytest.mark.long] * (name == "client")) for name in SAYS],
)
def test_example(name, capfd, monkeypatch):
    path = EXAMPLES / f"{name}.py"
    if name == "safe_policy":
        pytest.importorskip("torch", reason="PyTorch is not installed")
    if name in ("chain_of_nodes", "client"):  # they start ROS
        ended = subprocess.run([sys.executable, path], timeout=300, check=False)
        assert ended.returncode == 0
    else:  # `test_pip_install.py` starts them as programs
        monkeypatch.setattr(sys, "argv", [str(path)])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(path), run_name="__main__")
        assert not end.value.code
    said = capfd.readouterr().out
    assert re.search(SAYS[name], said), said


def test_the_policy_says_in_one_line_that_it_needs_pytorch(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(EXAMPLES / "safe_policy.py"), run_name="__main__")
    assert end.value.code == "safe_policy.py needs PyTorch: pip install torch"
