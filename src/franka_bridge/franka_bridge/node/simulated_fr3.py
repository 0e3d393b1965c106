# SPDX-License-Identifier: Apache-2.0
"""A simulated FR3 that speaks libfranka's protocol, and says whether it kept its limits."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import Executor
from rclpy.task import Future
from sensor_msgs.msg import JointState

from franka_bridge.limit_watch import LimitWatch
from franka_bridge.node.franka_parameters import TORQUE_RATE, SimulationConfiguration
from franka_bridge.simulated_arm import DT, SimulatedArm, SimulationError
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.runtime import GOAL_QOS, stamp_to_ns
from viability_bounds_pkg.ros.topics import JOINT_STATES

_TURN = 10
"""Periods simulated in a row, before messages have their turn."""


class SimulatedFr3(ArmNode):
    """An FR3 in MuJoCo, by franky-sim, for clients of libfranka at ``robot_ip``.

    Its own states and torques are judged by its limits in each period of 1 ms; ``/diagnostics``
    tells the result. It can be pushed by ``external_wrench``.
    """

    NAME = "simulated_fr3"
    PARAMETERS = SimulationConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            config = self._config = NodeParameters(self, SimulationConfiguration).configuration
            watch = LimitWatch(
                config.position_min,
                config.position_max,
                config.velocity_max,
                config.velocity_offset,
                config.deceleration_limit,
                config.torque_max,
                np.full(len(config.joints), TORQUE_RATE),
                DT,
            )
            waits = config.clock == "lockstep"
            try:
                self._arm = SimulatedArm(config.robot_ip, config.start_positions, watch, waits)
            except SimulationError as error:
                raise SettingError("robot_ip", config.robot_ip, f"free ({error})") from error
        self._stamp = 0
        self._pushes: list[tuple[int, WrenchStamped]] = []
        self._refused: Counter[str] = Counter()
        self._since = time.monotonic(), 0
        JOINT_STATES.subscription(self, self._on_state)
        self.create_subscription(WrenchStamped, "external_wrench", self._on_push, GOAL_QOS)
        self._diagnostics = Diagnostics(self, self._report, self.publisher_watch)
        self.announce(config.joints, 1.0 / DT, f"simulated at {config.robot_ip}")

    def run_once(self, executor: Executor, ended: Future) -> None:
        """Simulate some periods, then run callbacks."""
        for _ in range(_TURN):
            self._arm.step()
        executor.spin_until_future_complete(ended, timeout_sec=0.0)

    def _on_state(self, message: JointState) -> None:
        """Apply the pushes that are due in the robot time of the control."""
        self._stamp = stamp_to_ns(message.header.stamp)
        while self._pushes and self._pushes[0][0] <= self._stamp:
            _, push = self._pushes.pop(0)
            f, t = push.wrench.force, push.wrench.torque
            self._arm.push(
                push.header.frame_id, np.array([f.x, f.y, f.z]), np.array([t.x, t.y, t.z])
            )

    def _on_push(self, message: WrenchStamped) -> None:
        f, t = message.wrench.force, message.wrench.torque
        if not all(map(math.isfinite, (f.x, f.y, f.z, t.x, t.y, t.z))):
            self._refuse("it is not finite")
            return
        self._pushes.append((stamp_to_ns(message.header.stamp), message))
        self._pushes.sort(key=lambda each: each[0])

    def _refuse(self, reason: str) -> None:
        self._refused["external_wrench"] += 1
        self.get_logger().warning(f"external_wrench refused: {reason}")

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        arm, watch = self._arm, self._arm.watch
        (since, before), now = self._since, time.monotonic()
        self._since = now, arm.periods
        values = {
            "clock": self._config.clock,
            "stamp_ns": self._stamp,
            "period_s": DT,
            "periods": arm.periods,
            "rate_hz": (arm.periods - before) / (now - since),
            "physics_steps_per_period": 1,
            "deadline_misses": arm.missed,
            "control_command_success_rate": 1.0 - arm.missed / max(1, arm.periods),
            "late_periods": arm.late,
            "braked_periods": 0,
            "commands_refused": self._refused,
            "world_changes_pending": len(self._pushes),
            "latency_p50_us": math.nan,
            "latency_p99_us": math.nan,
            "position_violation_rad": watch.position,
            "velocity_violation_rad_s": watch.speed,
            "torque_ratio": watch.torque,
            "commanded_torque_ratio_max": float(watch.torque.max()),
            "torque_rate_ratio": watch.rate,
            "lower_clearance_rad": watch.lower,
            "upper_clearance_rad": watch.upper,
        }
        if watch.violated:
            return DiagnosticStatus.ERROR, "a limit was broken", values
        return DiagnosticStatus.OK, "running", values

    def destroy_node(self) -> None:
        """Stop listening, too."""
        if hasattr(self, "_arm"):
            self._arm.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the simulated robot until it is told to stop."""
    return run(SimulatedFr3, args)


if __name__ == "__main__":
    sys.exit(main())
