# SPDX-License-Identifier: Apache-2.0
"""Makes the file of a new robot's imperfect one: the largest errors that leave it enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torque_safety_controller.new_robot.chain import Chain, NewRobotError
from torque_safety_controller.new_robot.estimates import Estimates, estimate
from torque_safety_controller.new_robot.hardware import (
    ERRORS,
    QUICKEST,
    ROOM,
    Array,
    Errors,
    acceleration_errors,
    imperfect_file,
    with_rotors,
)
from torque_safety_controller.tools.gain_limits import HORIZON
from torque_safety_controller.tools.suitable_gains import IMPERFECT_GAINS, Gains, suitable_gains
from viability_bounds_pkg.exceptions import ArmSafetyError


def imperfect_text(
    chain: Chain,
    exact: Estimates,
    gains: Gains,
    urdf: str,
    exact_text: Callable[[Gains, str], str],
) -> str:
    """Return the file of an imperfect robot, with the largest errors that leave bounds.

    Args:
        chain: the arm.
        exact: its limits without rotors and errors.
        gains: in its own file.
        urdf: text of its URDF.
        exact_text: returns its own file, with gains and the place of the URDF.

    Raises:
        NewRobotError: no errors leave bounds.
    """
    real = with_rotors(chain, exact.v_max)
    estimates = estimate(real, exact.rate_hz)
    quickest = QUICKEST * estimates.v_max
    estimates = replace(
        estimates,
        a_min=np.maximum(estimates.a_min, -quickest),
        a_max=np.minimum(estimates.a_max, quickest),
    )
    reason = "they take too much of the acceleration limits"
    for errors in ERRORS:
        disturbance = acceleration_errors(real, estimates, errors)
        if (disturbance > ROOM * np.minimum(-estimates.a_min, estimates.a_max)).any():
            continue

        def texts(
            own: Gains, place: str, errors: Errors = errors, disturbance: Array = disturbance
        ) -> list[str]:
            changed = {name: value for name, value in own.items() if gains.get(name) != value}
            imperfect = imperfect_file(real, estimates, errors, disturbance, changed)
            return [exact_text(gains, place), imperfect]

        try:
            begin = {**gains, **IMPERFECT_GAINS, HORIZON: errors.horizon}
            return texts(suitable_gains(urdf, texts, begin), "")[1]
        except ArmSafetyError as error:  # they leave no bounds, or no gains suit
            reason = str(error)
    raise NewRobotError(
        f"no imperfect robot at {exact.rate_hz:g} Hz: with the least errors {reason}; a higher "
        "--rate, or a file of your own like those in config/imperfect"
    )
