# SPDX-License-Identifier: Apache-2.0
"""A simulated FR3 in a process of its own: libfranka's bindings let no other thread run here."""

import subprocess
import sys
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from viability_bounds_pkg.testing.executables import as_child

INSTALLED = bool(find_spec("pylibfranka") and find_spec("franky_sim"))
START = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)  # rad
ASSETS = Path(find_spec("franky_sim").origin).parent / "assets" if INSTALLED else Path()
VALUES = {
    "robot_description": str(ASSETS / "fr3.urdf"),
    "joints": [f"fr3_joint{j}" for j in range(1, 8)],
    "base_frame": "fr3_link0",
    "end_effector_frame": "fr3_hand_tcp",
    "rate_hz": 1000.0,
    "real_time": False,
    "command_includes_gravity": False,
    "acceleration_min": [-10.0, -3.0, -10.0, -10.0, -10.0, -10.0, -10.0],
    "acceleration_max": [10.0, 3.0, 10.0, 10.0, 10.0, 10.0, 10.0],
}
"""Parameters of the node, but for the address."""


class SimulatedFr3:
    """A robot that can be switched off and on; `address` stays the same."""

    def __init__(self):
        self.address = ""
        self.switch_on()

    def switch_on(self):
        self._process = subprocess.Popen(
            [sys.executable, __file__, self.address],
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=as_child,
        )
        self.address = self._process.stdout.readline().strip()

    def switch_off(self):
        self._process.kill()
        self._process.communicate()


@contextmanager
def simulated_fr3():
    robot = SimulatedFr3()
    try:
        yield robot
    finally:
        robot.switch_off()


def main():
    from franky_sim import SimulationServer
    from franky_sim.mujoco_simulator import MujocoSimulator

    with MujocoSimulator() as simulator:
        robot = simulator.add_robot(initial_q=START)
        places = {"hostname_candidates": [sys.argv[1]]} if sys.argv[1] else {}
        with SimulationServer(simulator, **places) as server:
            print(robot.hostname, flush=True)
            server.run_forever()


if __name__ == "__main__":
    main()
