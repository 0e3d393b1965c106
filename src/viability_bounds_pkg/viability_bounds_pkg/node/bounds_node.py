# SPDX-License-Identifier: Apache-2.0
"""The bounds node: joint states in, acceleration limits out."""

from __future__ import annotations

import sys
import time
from array import array
from collections import Counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.bounds.last_acceleration import BoundsAfterLast
from viability_bounds_pkg.node.bounds_parameters import (
    BoundsConfiguration,
    make_bounds,
    make_jerk_solver,
    make_plausibility_check,
    make_solver,
)
from viability_bounds_pkg.robot.configuration import TOPIC
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import Arrival, JointOrder, JointStateReader, PeriodCheck
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.refusals import count_refusal
from viability_bounds_pkg.ros.robot_urdf import warn_of_unusual
from viability_bounds_pkg.ros.runtime import set_stamp, stamp_to_ns, steady_timer
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    COMMANDED_ACCELERATIONS,
    LIMIT_DISTANCES,
    SLOW_ACCELERATION_LIMITS,
    SLOW_JOINT_STATES,
)
from viability_bounds_pkg.viability import BoundsSolver

_SLOW_PERIOD = 0.05
"""Between two copies of the streams for tools, s."""


class BoundsNode(ArmNode):
    """Answers every joint state with the accelerations that keep the limits for ever.

    Subscribes to ``joint_states`` or ``estimated_joint_states``, and with ``jerk_max`` to
    ``commanded_accelerations``; publishes
    ``acceleration_limits`` with the stamp of the state that it answers:
    ``points[0].accelerations`` lower, ``points[1].accelerations`` upper, rad/s^2, in the order of
    the parameter ``joints``.
    """

    NAME = "bounds_node"
    PARAMETERS = BoundsConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            self._node_parameters = NodeParameters(
                self, BoundsConfiguration, self._configure, _check
            )
            config = self._node_parameters.configuration
            if config.robot_description not in ("", TOPIC):
                warn_of_unusual(self, config, config.read_urdf())
            self._bounds, self._last = make_bounds(config), None
            if len(config.jerk_max):
                self._last = BoundsAfterLast(make_jerk_solver(config))
                self._bounds = self._last.bounds
        joints = config.joints
        check = None
        if not config.use_estimated_states:
            check = make_plausibility_check(config, config.declared)
        self._reader = JointStateReader(
            joints, config.state_timeout, self._warn, check, continuous=config.continuous
        )
        self._gap = 1e9 * config.state_timeout  # ns
        self._period = PeriodCheck(config.dt, self._warn)
        self._answered = 0
        self._outside = np.zeros(len(joints), dtype=int)
        self._answer = JointTrajectory(
            joint_names=list(joints), points=[JointTrajectoryPoint(), JointTrajectoryPoint()]
        )
        self._limits = self.stream(ACCELERATION_LIMITS)
        self.listen_to_states(config.use_estimated_states, self._on_state, config.joints)
        self._order = JointOrder(joints)
        self._refused: Counter[str] = Counter()
        if self._last:
            self.listen(COMMANDED_ACCELERATIONS, self._on_accelerations)
        self._slow_states = SLOW_JOINT_STATES.publisher(self)
        self._slow_limits = SLOW_ACCELERATION_LIMITS.publisher(self)
        self._distances = LIMIT_DISTANCES.publisher(self)
        # Beside the answers to states, which do no work for these topics.
        steady_timer(self, _SLOW_PERIOD, self._publish_slowly)
        self._diagnostics = Diagnostics(self, self._report, self.publisher_watch)
        self._warn_of_reduced_braking(config)
        self.announce(joints, config.rate_hz, f"method {config.method}")

    def _configure(self, config: BoundsConfiguration) -> None:
        if self._last:
            self._last.solver = make_jerk_solver(config)
        else:
            self._bounds = make_bounds(config)
        self._warn_of_reduced_braking(config)

    def _warn_of_reduced_braking(self, config: BoundsConfiguration) -> None:
        if config.method != "exact":
            self._warn(f"method '{config.method}' does not keep the limits; it is for comparison")
            return
        if len(config.jerk_max):
            solver: BoundsSolver | JerkBoundsSolver = make_jerk_solver(config)
            why = "has too small a jerk_max for all of its braking (docs/theory/jerk.md)"
        else:
            solver = make_solver(config)
            why = "can cross its range or exceed its speed within one braking step "
            why += "(condition (11))"
        for name, full, (up, low) in zip(
            config.joints, solver.exact, solver.braking.tolist(), strict=True
        ):
            if not full:
                self.get_logger().warning(
                    f"joint '{name}' {why}; its bounds count on decelerations of {up:.3g} before "
                    f"the upper limit and {low:.3g} before the lower one"
                )

    def _on_state(self, message: JointState) -> None:
        before = self._reader.stamp
        arrival = self._reader.read(message, time.monotonic())
        if arrival is Arrival.REFUSED:
            return
        if arrival is Arrival.NEW:
            if self._last and not 0 < self._reader.stamp - before <= self._gap:
                self._last.reset()
            bounds = self._bounds(self._reader.q, self._reader.v)
            points = self._answer.points
            points[0].accelerations = array("d", bounds.lower.tobytes())
            points[1].accelerations = array("d", bounds.upper.tobytes())
            self._answer.header.stamp = message.header.stamp
            if False in bounds.viable.tolist():  # faster than NumPy's for few
                self._outside += ~bounds.viable
            self._answered += 1
        self._limits.publish(self._answer)

    def _on_accelerations(self, message: JointTrajectory) -> None:
        """Take what was commanded for the last state; later, it says nothing any more."""
        reason, detail = self._order.find(message.joint_names)
        a = np.array([point.accelerations for point in message.points])
        if not reason and a.shape != (1, len(message.joint_names)):
            reason = "wrong size"
        elif not reason and not np.isfinite(a).all():
            reason = "not finite"
        if reason:
            count_refusal(COMMANDED_ACCELERATIONS.name, reason, detail, self._refused, self._warn)
        elif self._last and stamp_to_ns(message.header.stamp) == self._reader.stamp:
            self._last.commanded(a[0, self._order.index])

    def _publish_slowly(self) -> None:
        """Publish distances to the limits, and copies of the streams, where they are heard."""
        silence = time.monotonic() - self._reader.heard_at
        if silence > self._node_parameters.configuration.state_timeout:
            return
        if self._slow_states.get_subscription_count():
            self._slow_states.publish(self._reader.message)
        if self._slow_limits.get_subscription_count():
            self._slow_limits.publish(self._answer)
        if self._distances.get_subscription_count():
            self._distances.publish(self._limit_distances())

    def _limit_distances(self) -> JointState:
        config, reader = self._node_parameters.configuration, self._reader
        tau = reader.effort()
        distances = np.minimum(reader.q - config.position_min, config.position_max - reader.q)
        lowest, highest = config.limits.velocities(reader.q)
        slower = np.minimum(reader.v - lowest, highest - reader.v)
        message = JointState(
            name=list(config.joints),
            position=array("d", distances.tobytes()),
            velocity=array("d", slower.tobytes()),
        )
        if tau is not None and len(config.torque_max) and config.effort_includes_gravity:
            message.effort = array("d", (config.torque_max - np.abs(tau)).tobytes())
        set_stamp(message.header.stamp, reader.stamp)
        return message

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        config = self._node_parameters.configuration
        self._period.compare(self._reader)
        values = {
            "method": config.method,
            "control_period_s": config.dt,
            "bounds_period_s": config.horizon,
            "position_margin_rad": config.margins.position,
            "velocity_margin_rad_s": config.margins.velocity,
            "acceleration_margin_rad_s2": config.margins.acceleration,
            "position_error_rad": config.uncertainty.position_error,
            "velocity_error_rad_s": config.uncertainty.velocity_error,
            "states_answered": self._answered,
            "states_refused": self._reader.refused,
            "states_outside_kernel_by_joint": self._outside,
        }
        if self._last:
            values["last_acceleration_unknown"] = self._last.unknown
            values["accelerations_refused"] = self._refused
        if self._reader.stamp < 0:
            source = " from estimator_node" if self.uses_estimates else ""
            return DiagnosticStatus.WARN, f"no joint state{source} yet", values
        if self._reader.refused:
            return DiagnosticStatus.WARN, "joint states were refused", values
        return DiagnosticStatus.OK, "answering", values


def _check(config: BoundsConfiguration) -> None:
    """Raise `SettingError` where there are no bounds."""
    make_bounds(config)
    if len(config.jerk_max):
        make_jerk_solver(config)


def main(args: list[str] | None = None) -> int:
    """Run the bounds node until it is told to stop."""
    return run(BoundsNode, args)


if __name__ == "__main__":
    sys.exit(main())
