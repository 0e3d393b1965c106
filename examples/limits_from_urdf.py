# SPDX-License-Identifier: Apache-2.0
"""Acceleration limits that a robot's torque limits can always provide, from its URDF.

    python examples/limits_from_urdf.py [URDF]

The default is the Franka Panda of the example-robot-data package. Where the motors are too weak
for the URDF's speeds, slower ones are taken, as the estimator suggests.
"""

from __future__ import annotations

import sys

import numpy as np
import pinocchio as pin

from viability_bounds_pkg.acceleration_limits import (
    EmptyIntervalError,
    estimate_acceleration_limits,
)
from viability_bounds_pkg.robot.description import build_model, kinematic_order
from viability_bounds_pkg.robot.files import read_urdf

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"


def main(uri: str = PANDA) -> int:
    """Print the limits found; return 1 where a random state breaks them."""
    urdf = read_urdf(uri)
    free = pin.buildModelFromXML(urdf)
    revolute = [free.names[i] for i in range(1, free.njoints) if "finger" not in free.names[i]]
    model = build_model(urdf, kinematic_order(urdf, revolute))
    q_min, q_max = model.lowerPositionLimit, model.upperPositionLimit
    v_max, tau_max = np.array(model.velocityLimit), model.effortLimit
    while True:
        try:
            found = estimate_acceleration_limits(
                model, q_min, q_max, v_max, tau_max, method="refined"
            )
            break
        except EmptyIntervalError as error:
            print(error)
            if error.scale == 0.0:
                return 1
            v_max = 0.99 * error.scale * v_max
    for name, low, high, speed in zip(found.names, found.a_min, found.a_max, v_max, strict=True):
        print(f"{name}: {low:8.2f} to {high:7.2f} rad/s^2 at up to {speed:.2f} rad/s")
    rng, data, broken = np.random.default_rng(1), model.createData(), 0
    for _ in range(5000):
        q, v = rng.uniform(q_min, q_max), rng.uniform(-v_max, v_max)
        inertia, h = pin.crba(model, data, q).diagonal(), pin.rnea(model, data, q, v, 0.0 * v)
        room_up, room_down = (tau_max - h) / inertia, (tau_max + h) / inertia
        broken += bool(((room_up < found.a_max) | (room_down < -found.a_min)).any())
    print(f"random states in which the torque does not suffice: {broken} of 5000")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
