# SPDX-License-Identifier: Apache-2.0
"""Prints how far a scenario has come."""

from __future__ import annotations

import time

import numpy as np

from sim_bridge.node.run_recorder import RunRecorder
from sim_bridge.scenario.scenario import ScenarioConfiguration
from viability_bounds_pkg.robot.urdf_joints import units_of

_WAIT_SHOWN_AFTER = 10.0  # s


class Progress:
    """Prints a line for each quarter of a scenario, and what it waits for if that lasts.

    Args:
        config: the scenario and its arm.
        recorder: of the messages.
    """

    def __init__(self, config: ScenarioConfiguration, recorder: RunRecorder) -> None:
        self._config, self._recorder = config, recorder
        self._units = units_of(config.urdf, config.joints)
        self._duration, self._quarter = config.plan.duration, 0
        self._reason, self._waiting_since = "", time.monotonic()
        print("waiting for the nodes", flush=True)

    def wait(self, reason: str) -> None:
        """Print why the scenario does not start, if that has lasted for a while."""
        now = time.monotonic()
        if reason != self._reason and now - self._waiting_since > _WAIT_SHOWN_AFTER:
            self._reason, self._waiting_since = reason, now
            print(reason, flush=True)

    def show(self, played: float) -> None:
        """Print the state of the run when a quarter is over; `played`: robot time so far, s."""
        if (quarter := int(4.0 * played / self._duration + 1e-6)) > self._quarter:
            self._quarter = quarter
            print(f"{played:6.2f} of {self._duration:g} s  {self._state()}", flush=True)

    def _state(self) -> str:
        """Return the state of the run in a line."""
        config, recorder = self._config, self._recorder
        q, low, high = recorder.q, config.position_min, config.position_max
        distance = np.minimum(q - low, high - q)
        nearest = int(np.argmin(distance))
        controller = recorder.diagnostics["controller_node"]
        state = (
            f"{controller.get('mode', '')}  "
            f"nearest limit {config.joints[nearest]} {distance[nearest]:+.4f} "
            f"{self._units[nearest]}"
        )
        error = float(controller.get("position_error_m", "nan"))
        if np.isfinite(error):  # there is a goal
            state += f"  pose error {1e3 * error:.2f} mm"
        return f"{state}  {float(recorder.diagnostics[config.robot_node]['rate_hz']):.0f} Hz"
