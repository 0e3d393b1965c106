# SPDX-License-Identifier: Apache-2.0
"""A driver's loop that brings the arm to rest within its limits when commands stop.

Panda is driven towards its limits at full speed. In the middle of it the commands cease; 2 ms
later the driver takes over. The robot is Pinocchio's forward dynamics.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pinocchio as pin

from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.stop import CoordinatedStop
from viability_bounds_pkg.viability import BoundsSolver

CONFIG = Path(__file__).resolve().parent.parent / "config" / "panda.yaml"
H = 0.001  # s, step of the driver
LAST_COMMAND, TIMEOUT, END = 950, 2, 2000  # steps
A_MAX = np.array([15.0, 3.0, 15.0, 15.0, 15.0, 15.0, 15.0])  # rad/s^2, as in the file
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])  # rad


def main() -> int:
    """Drive, cut the commands, stop; print what became of it; return 1 if a limit was passed."""
    robot = read_robot(CONFIG)
    model, data = robot.model, robot.model.createData()
    limits = JointLimits(
        list(model.names)[1:], robot.q_min, robot.q_max, robot.v_max, -A_MAX, A_MAX
    )
    stop = CoordinatedStop(model, limits, robot.tau_max, H)
    controller = BoundsSolver(limits, 4 * H, 0.1 * A_MAX, period=H)
    q, v, tau = START, np.zeros(model.nv), np.zeros(model.nv)
    nearest, fastest, at_rest = np.inf, -np.inf, 0
    for step in range(END):
        silent = step - LAST_COMMAND
        if silent <= 0:  # a command: as fast as the bounds allow
            a = controller.bounds(q, v).upper
            tau = pin.rnea(model, data, q + 0.5 * H * v, v + 0.5 * H * a, a)
        elif silent >= TIMEOUT:  # between them the last command is held
            if silent == TIMEOUT:
                print(f"stops from {np.abs(v).max():.2f} rad/s: {stop.time_to_rest(v):.3f} s")
                stop.start(q, v)
            tau = stop.torque(q, v)
            at_rest = at_rest or step * stop.at_rest
        a = pin.aba(model, data, q + 0.5 * H * v, v, tau)
        q, v = q + H * v + 0.5 * H * H * a, v + H * a
        nearest = min(nearest, float(np.minimum(robot.q_max - q, q - robot.q_min).min()))
        fastest = max(fastest, float((np.abs(v) - robot.v_max).max()))
    print(f"at rest after {(at_rest - LAST_COMMAND - TIMEOUT) * H:.3f} s, and held for the rest")
    print(f"nearest to a limit: {nearest:.1e} rad, {-fastest:.1e} rad/s inside")
    return 0 if stop.at_rest and nearest >= 0.0 and fastest <= 0.0 else 1


if __name__ == "__main__":
    sys.exit(main())
