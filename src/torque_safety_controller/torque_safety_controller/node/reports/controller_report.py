# SPDX-License-Identifier: Apache-2.0
"""Statistics of the control steps for /diagnostics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from diagnostic_msgs.msg import DiagnosticStatus

from torque_safety_controller.controller import Controller, ControlOutput
from torque_safety_controller.supervisor import Mode
from viability_bounds_pkg.recent_values import RecentValues

LEVELS = {
    Mode.TRACKING: DiagnosticStatus.OK,
    Mode.POSITION: DiagnosticStatus.OK,
    Mode.HOLD: DiagnosticStatus.WARN,
    Mode.STOPPED: DiagnosticStatus.ERROR,
}

_SLIGHT = 1e-3  # rad/s^2; smaller relaxations of bounds come with those of distances


_STANDS = 1.0
"""How long the arm stands before it is told, s."""

_PROGRESS = np.array([1e-3, 5e-3])
"""By how much it must come nearer meanwhile, m and rad; an arm may shake where it stands."""

_NEAR = 0.01
"""Distance at which a joint is on a position limit, rad."""

_SHORT = np.array([0.005, 0.02])
"""What counts as short of the goal, m and rad."""


class StepRecord:
    """Counts steps, failures and relaxations, and keeps latencies.

    Args:
        n: number of joints.
    """

    def __init__(self, n: int) -> None:
        self._steps = self._relaxed_steps = self._failures = 0
        self._latencies = RecentValues()
        self._last_relaxation = np.zeros(n)

    def note(self, step: ControlOutput, latency: float) -> None:
        """Count a step that was answered `latency` seconds after its state came."""
        self._latencies.note(latency)
        self._steps += 1
        if step.failure:
            self._failures += 1
        if step.relaxation is not None and step.relaxation.max() > _SLIGHT:
            self._relaxed_steps += 1
            self._last_relaxation = step.relaxation

    def values(
        self,
        joints: tuple[str, ...],
        controller: Controller,
        a_lower: np.ndarray,
        a_upper: np.ndarray,
    ) -> dict[str, Any]:
        """Return what to report.

        Args:
            joints: names of the n joints.
            controller: which they are controlled by.
            a_lower: acceleration limits of the last step, shape (n,), rad/s^2.
            a_upper: shape (n,), rad/s^2.
        """
        a = controller.acceleration
        near = 1e-3 * (a_upper - a_lower) + 1e-6
        at_limit = (a <= a_lower + near) | (a >= a_upper - near)
        error = controller.goals.error(controller.robot.pose)
        values = {
            "steps": self._steps,
            "position_error_m": float(np.linalg.norm(error[:3])),
            "orientation_error_rad": float(np.linalg.norm(error[3:])),
            "qp_iterations": controller.iterations,
            "qp_failures": self._failures,
            "bounds_relaxed_steps": self._relaxed_steps,
            "bounds_last_relaxation_rad_s2": self._last_relaxation,
            "joints_at_acceleration_limit": _named(joints, at_limit),
            "latency_p50_us": 1e6 * self._latencies.percentile(50),
            "latency_p99_us": 1e6 * self._latencies.percentile(99),
        }
        integral, friction = controller.integral, controller.friction
        if integral is not None and friction is not None:
            values |= {
                "additional_torque_nm": integral.last + friction.last,
                "friction_torque_nm": friction.last,
                "joints_at_integral_budget": _named(joints, integral.saturated),
                "integral_skipped_steps": integral.skipped,
            }
        if controller.safety_filter is not None:
            values |= {
                "steps_by_plan": controller.safety_filter.outcomes,
                "plan_torque_left": controller.safety_filter.slack,
                "joints_too_weak_to_hold": too_weak(joints, controller) or "none",
            }
        return values


def too_weak(joints: tuple[str, ...], controller: Controller) -> str:
    """Return which joints cannot hold the arm where it would come to rest; empty for none."""
    if controller.safety_filter is None:
        return ""
    return _beyond(joints, controller.safety_filter.rest_torque, controller.tau_max)


def goal_too_heavy(joints: tuple[str, ...], controller: Controller) -> str:
    """Return which joints cannot hold the arm at the joints' goal; empty for none."""
    goals, robot = controller.goals, controller.robot
    if goals.q_des is None or goals.pose_des is not None:
        return ""
    torque = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), goals.q_des)
    return _beyond(joints, torque, controller.tau_max)


def _beyond(joints: tuple[str, ...], torque: np.ndarray, most: np.ndarray) -> str:
    """Return which joints need more torque than they have; empty for none."""
    return ", ".join(
        f"{name} needs {needed:.1f} of {limit:.1f} N m"
        for name, needed, limit in zip(joints, np.abs(torque), most, strict=True)
        if needed > limit
    )


class Shortfall:
    """Tells that the arm stands short of a pose that stays the goal.

    Args:
        joints: names of the n joints.
        q_min: lower position limits, shape (n,), rad.
        q_max: upper ones, shape (n,), rad.
    """

    def __init__(self, joints: tuple[str, ...], q_min: np.ndarray, q_max: np.ndarray) -> None:
        self._joints, self._q_min, self._q_max = joints, q_min, q_max
        self._goal: pin.SE3 | None = None
        self._since = 0.0
        self._least = np.zeros(2)

    def look(self, controller: Controller, now: float) -> str:
        """Return by how much, once it has come no nearer for `_STANDS`; else nothing.

        Args:
            controller: of the arm.
            now: the robot's time, s.
        """
        goal, robot = controller.goals.pose_des, controller.robot
        if goal is None:
            self._goal = None
            return ""
        error = controller.goals.error(robot.pose)
        left = np.array([np.linalg.norm(part) for part in np.split(error, 2)])
        if self._goal is None or goal != self._goal or now < self._since:
            self._goal, self._since, self._least = goal.copy(), now, left
        elif (self._least - left > _PROGRESS).any():
            self._since, self._least = now, np.minimum(left, self._least)
        if now - self._since < _STANDS or (left < _SHORT).all():
            return ""
        near = np.minimum(robot.q - self._q_min, self._q_max - robot.q) < _NEAR
        text = f"stands {1e3 * left[0]:.0f} mm and {left[1]:.2f} rad short of its goal"
        return text + (f", on limits of {_named(self._joints, near)}" if near.any() else "")


def _named(joints: tuple[str, ...], flags: np.ndarray) -> str:
    """Return the names of the joints that are flagged."""
    return ", ".join(name for name, flag in zip(joints, flags, strict=True) if flag) or "none"
