"""The bounds node: joint states in, acceleration limits out."""

from __future__ import annotations

import sys
import time
from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.ros_messages import Diagnostics, JointStateReader, Verdict
from viability_bounds_pkg.ros_parameters import (
    NodeParameters,
    Parameter,
    ParameterError,
    joint_names,
    per_joint,
    positive,
)
from viability_bounds_pkg.ros_runtime import CONTROL_QOS, run
from viability_bounds_pkg.torque_margin import TorqueMargins, tightened, torque_margins

RIVALS = {
    "naive": baselines.naive_bounds,
    "decre": baselines.decre_bounds,
    "rubrecht": baselines.rubrecht_bounds,
}
"""Methods to compare with that need no settings of their own."""

METHODS = ("exact", *RIVALS, "damper")

TABLE = (
    Parameter("joints", list[str], "names of the joints, in the order of all arrays"),
    Parameter("position_min", list[float], "lower position limits, rad; -.inf if continuous"),
    Parameter("position_max", list[float], "upper position limits, rad; .inf if continuous"),
    Parameter("velocity_max", list[float], "speed limits, rad/s"),
    Parameter("acceleration_min", list[float], "lower acceleration limits, rad/s^2, < 0"),
    Parameter("acceleration_max", list[float], "upper acceleration limits, rad/s^2, > 0"),
    Parameter(
        "acceleration_drift",
        list[float],
        "how fast the acceleration changes while a torque is held, rad/s^3; the bounds keep "
        "back what follows from it at this rate",
        default=np.zeros(0),
    ),
    Parameter(
        "position_margin",
        float,
        "how much further inside the position limits to keep the joints, rad: what the robot or "
        "its sensors may be off",
        default=0.0,
    ),
    Parameter("rate_hz", float, "rate of the control loop, Hz"),
    Parameter(
        "bounds_dt_factor",
        float,
        "horizon of the bounds in control periods; 2 takes the chatter out",
        default=2.0,
        live=True,
    ),
    Parameter("method", str, f"one of: {', '.join(METHODS)}", default="exact", live=True),
    Parameter(
        "damper_influence",
        float,
        "for method damper: distance to a limit from which on it acts, rad",
        default=0.2,
    ),
    Parameter("damper_gain", float, "for method damper: speed allowed there, rad/s", default=1.0),
    Parameter(
        "state_timeout", float, "silence after which older stamps are taken again, s", default=0.5
    ),
)

PARAMETER_OF = {
    "names": "joints",
    "q_min": "position_min",
    "q_max": "position_max",
    "v_max": "velocity_max",
    "a_min": "acceleration_min",
    "a_max": "acceleration_max",
    "margin": "acceleration_drift",
    "dt": "bounds_dt_factor",
    "period": "rate_hz",
}


@dataclass(frozen=True)
class BoundsConfiguration:
    """Checked parameters of the bounds node."""

    limits: JointLimits
    margins: TorqueMargins
    """What the exact bounds keep back."""
    control_dt: float
    bounds_dt: float
    method: str
    state_timeout: float
    solve: Any
    """(q, v) -> AccelerationBounds."""


def make_configuration(values: Mapping[str, Any]) -> BoundsConfiguration:
    """Check parameter values and make what the node runs on of them.

    Raises:
        ParameterError: one of them cannot be used.
    """
    joints = joint_names(values)
    if values["method"] not in METHODS:
        raise ParameterError("method", values["method"], f"one of {', '.join(METHODS)}")
    dt = 1.0 / positive(values, "rate_hz")
    factor = positive(values, "bounds_dt_factor")
    if factor < 1.0:
        raise ParameterError("bounds_dt_factor", factor, ">= 1")
    try:
        limits = JointLimits(
            joints,
            *(
                per_joint(values, PARAMETER_OF[field], joints)
                for field in ("q_min", "q_max", "v_max", "a_min", "a_max")
            ),
        )
        margins = _margins(values, limits, dt)
        method = values["method"]
        if method == "exact":
            inner = tightened(limits, margins)
            solver = viability.BoundsSolver(inner, factor * dt, margins.acceleration, period=dt)
            solve = solver.bounds
        elif method == "damper":
            solve = partial(
                baselines.damper_bounds,
                limits=limits,
                dt=factor * dt,
                influence=positive(values, "damper_influence"),
                gain=positive(values, "damper_gain"),
            )
        else:
            solve = partial(RIVALS[method], limits=limits, dt=factor * dt)
    except JointLimitsError as error:
        name = PARAMETER_OF[error.field]
        shown = error.value if error.joint is None else f"{error.value} for {error.joint}"
        raise ParameterError(name, shown, error.allowed) from error
    return BoundsConfiguration(
        limits=limits,
        margins=margins,
        control_dt=dt,
        bounds_dt=factor * dt,
        method=values["method"],
        state_timeout=positive(values, "state_timeout"),
        solve=solve,
    )


def _margins(values: Mapping[str, Any], limits: JointLimits, dt: float) -> TorqueMargins:
    """Return what to keep back for the drift of acceleration and for the robot itself."""
    drift = np.zeros(len(limits))
    if len(values["acceleration_drift"]):
        drift = per_joint(values, "acceleration_drift", limits.names)
        if not (np.isfinite(drift).all() and (drift >= 0.0).all()):
            raise ParameterError("acceleration_drift", drift, "finite numbers >= 0")
    margins = torque_margins(drift, dt)
    margins.position[:] += positive(values, "position_margin", zero=True)
    for name, margin, room in (
        ("velocity_max", margins.velocity, limits.v_max),
        ("position_max", margins.position, 0.5 * (limits.q_max - limits.q_min)),
    ):
        if not (margin < room).all():
            raise ParameterError(
                name,
                values[name],
                f"more than the margins for acceleration_drift at this rate take: {margin}",
            )
    return margins


class BoundsNode(Node):
    """Answers every joint state with the accelerations that keep the limits for ever.

    Subscribes to ``joint_states``; publishes ``acceleration_limits`` with the stamp of the
    state that it answers: ``points[0].accelerations`` lower, ``points[1].accelerations``
    upper, rad/s^2, in the order of the parameter ``joints``.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("bounds_node", **node_arguments)
        try:
            self._node_parameters = NodeParameters(
                self, TABLE, make_configuration, self._configure
            )
        except ParameterError:
            self.destroy_node()
            raise
        config = self._node_parameters.configuration
        joints = config.limits.names
        self._solve = config.solve
        self._reader = JointStateReader(joints, config.state_timeout)
        self._answered = 0
        self._outside = np.zeros(len(joints), dtype=int)
        self._answer = JointTrajectory(
            joint_names=list(joints), points=[JointTrajectoryPoint(), JointTrajectoryPoint()]
        )
        self._publisher = self.create_publisher(
            JointTrajectory, "acceleration_limits", CONTROL_QOS
        )
        self.create_subscription(JointState, "joint_states", self._on_state, CONTROL_QOS)
        self._diagnostics = Diagnostics(self, self._report)
        self._warn_of_affected_joints(config)

    def _configure(self, config: BoundsConfiguration) -> None:
        self._solve = config.solve
        self._warn_of_affected_joints(config)

    def _warn_of_affected_joints(self, config: BoundsConfiguration) -> None:
        if config.method != "exact":
            self.get_logger().warning(
                f"method '{config.method}' does not keep the limits; it is for comparison"
            )
            return
        holds = viability.condition_11(config.limits, config.bounds_dt)
        for name, fine in zip(config.limits.names, holds, strict=True):
            if not fine:
                self.get_logger().warning(
                    f"joint '{name}' can cross its range or exceed its speed within one braking "
                    f"step of {config.bounds_dt:g} s (condition (11)); its bounds are stricter"
                )

    def _on_state(self, message: JointState) -> None:
        verdict = self._reader.read(message, time.monotonic())
        if verdict is Verdict.REFUSED:
            return
        if verdict is Verdict.NEW:
            bounds = self._solve(self._reader.q, self._reader.v)
            points = self._answer.points
            points[0].accelerations = array("d", bounds.lower.tobytes())
            points[1].accelerations = array("d", bounds.upper.tobytes())
            self._answer.header.stamp = message.header.stamp
            if not bounds.viable.all():
                self._outside += ~bounds.viable
            self._answered += 1
        self._publisher.publish(self._answer)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        config = self._node_parameters.configuration
        silent = self._reader.stamp < 0
        values = {
            "method": config.method,
            "control_period_s": config.control_dt,
            "bounds_period_s": config.bounds_dt,
            "position_margin_rad": config.margins.position,
            "velocity_margin_rad_s": config.margins.velocity,
            "acceleration_margin_rad_s2": config.margins.acceleration,
            "states_answered": self._answered,
            "states_refused": self._reader.refused,
            "states_outside_kernel_by_joint": self._outside,
        }
        if silent:
            return DiagnosticStatus.WARN, "no joint state yet", values
        if self._reader.refused:
            return DiagnosticStatus.WARN, "joint states were refused", values
        return DiagnosticStatus.OK, "answering", values


def main(args: list[str] | None = None) -> int:
    """Run the bounds node until it is told to stop."""
    return run(BoundsNode, args)


if __name__ == "__main__":
    sys.exit(main())
