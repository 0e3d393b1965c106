# SPDX-License-Identifier: Apache-2.0
"""Every example runs, keeps every limit, and says so."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SAYS = {
    "bounds_alone": r"exact bounds 0\.0e\+00, naive bounds [1-9]",
    "chain_of_nodes": r"positions at most 0 rad beyond their\nlimits, speeds 0 rad/s",
    "client": r"joints moved by \[0\.(2|19) .*\nhand moved by .*\none metre higher: it stands \d",
    "controller_without_ros": r"rad, .* rad/s, .* N m inside\njoints at rest on a limit: \['",
    "driver_that_stops": r"at rest after 0\.5\d\d s.*\nnearest to a limit: \d.*e-0[67] rad, \d",
    "mujoco_panda": r"largest speed 99\.\d% of its limit.*\n.*\n-\S+ rad, -\S+ rad/s, -",
    "limits_from_urdf": r"torque does not suffice: 0 of 5000",
}


def test_every_example_is_run_here():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAYS)


@pytest.mark.parametrize("name", SAYS)
def test_example(name, capfd, monkeypatch):
    path = EXAMPLES / f"{name}.py"
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
