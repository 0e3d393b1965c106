# SPDX-License-Identifier: Apache-2.0
"""The estimator node: joint states in, joint states as commands will meet them out."""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState

from viability_bounds_pkg.node.bounds_parameters import make_plausibility_check
from viability_bounds_pkg.parameter import group, timeout
from viability_bounds_pkg.robot.configuration import (
    ControlRate,
    LimitedRobotConfiguration,
    load_model,
)
from viability_bounds_pkg.robot.gravity import TorqueConvention, gravity_beyond
from viability_bounds_pkg.robot.locked_joints import LockedJoints
from viability_bounds_pkg.robot.payload import Payload
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import (
    Arrival,
    CommandReader,
    JointStateReader,
    PeriodCheck,
    TorqueCommand,
)
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.payload import PayloadSubscriber
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.robot_urdf import robot_urdf, warn_of_unusual
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import ESTIMATED_JOINT_STATES, JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import ObserverDesign
from viability_bounds_pkg.uncertainty import DeclaredUncertainty, VelocityEstimation


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimatorConfiguration(
    VelocityEstimation, ControlRate, TorqueConvention, LimitedRobotConfiguration
):
    """Parameters of the estimator node."""

    declared: DeclaredUncertainty = group(DeclaredUncertainty)
    state_timeout: float = timeout(
        "silence after which older stamps are accepted again, s", default=0.5
    )

    @property
    def observers(self) -> ObserverDesign | None:
        """Observers of the velocities; None where they are not estimated."""
        return self.declared.observers(self.dt) if self.velocity_estimation else None


def make_estimator(config: EstimatorConfiguration, model: pin.Model) -> StateEstimator:
    """Return the estimator of an arm."""
    declared = config.declared
    return StateEstimator(
        model,
        config.dt,
        declared.delay,
        declared.motor_lag,
        config.observers,
        config.velocity_max,
        config.torque_max,
        declared.lasting_disturbance,
        1 + declared.missed_deadlines,
    )


class EstimatorNode(ArmNode):
    """Answers every joint state with the one in which the command that answers it will act.

    Subscribes to ``joint_states`` and ``joint_commands``; publishes ``estimated_joint_states``
    with the stamp and the effort of the state that it answers, and all other joints as they came.

    Attributes:
        commands_heard: how many commands came, refused ones included.
    """

    NAME = "estimator_node"
    PARAMETERS = EstimatorConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            parameters = NodeParameters(self, EstimatorConfiguration)
            config = self._config = parameters.configuration
            urdf = robot_urdf(config, self)
            warn_of_unusual(self, config, urdf)
            model = load_model(config, urdf)
            self._estimator = make_estimator(config, model)
            payload = Payload(model)
            self._locked = LockedJoints(config, urdf, model, payload)
        joints = config.joints
        self._joints = list(joints)
        self._observers = config.observers
        check = make_plausibility_check(config, config.declared, not config.velocity_estimation)
        self._reader = JointStateReader(
            joints,
            config.state_timeout,
            self._warn,
            check,
            needs_velocities=not config.velocity_estimation,
            continuous=config.continuous,
            gravity=gravity_beyond(model, config.effort_includes_gravity),
        )
        self._gravity = gravity_beyond(model, config.command_includes_gravity)
        self._period = PeriodCheck(config.dt, self._warn)
        self._refused: Counter[str] = Counter()
        self._commands = CommandReader(joints, self._refused, self._warn)
        self._answered = self._restarts = self.commands_heard = 0
        self._answer = JointState()
        self._estimates = self.stream(ESTIMATED_JOINT_STATES)
        self.listen(JOINT_STATES, self._on_state, joints=joints)
        self.listen(JOINT_COMMANDS, self._on_command)
        self._payload = PayloadSubscriber(self, payload)
        self._diagnostics = Diagnostics(self, self._report, self.publisher_watch)
        source = "estimated" if config.velocity_estimation else "as reported"
        lag = 1e3 * config.declared.motor_lag
        self.announce(
            joints,
            config.rate_hz,
            f"velocities {source}, delay of {config.declared.delay} periods, motors' lag of "
            f"{lag.min():.3g} to {lag.max():.3g} ms",
        )

    def _on_state(self, message: JointState) -> None:
        reader = self._reader
        arrival = reader.read(message, time.monotonic())
        if arrival is Arrival.REFUSED:
            return
        if arrival is Arrival.NEW:
            reported = State(reader.q, reader.v)
            estimator = self._estimator
            state = estimator.step(reader.stamp, reported, reader.effort())
            self._answer = reader.with_state(state)
            self._answered += 1
        self._estimates.publish(self._answer)
        if self._locked.due(reader.stamp) and reader.message is not None:
            self._locked.look(reader.message.name, reader.message.position, reader.stamp)
        if arrival is Arrival.NEW and self._estimator.resets.total() != self._restarts:
            self._tell_restart()

    def _tell_restart(self) -> None:
        resets = self._estimator.resets
        self._restarts = resets.total()
        if self._restarts == 1:
            (reason,) = resets
            self._warn(f"starts anew from the reported state: {reason}; later ones are counted")

    def _on_command(self, message: JointState) -> None:
        self.commands_heard += 1
        command = self._commands.read(message)
        if command is None:
            return
        tau = None
        if isinstance(command, TorqueCommand):
            tau = command.tau
            if self._gravity is not None:
                tau = tau + self._gravity(self._reader.q)
            tau_max = self._config.torque_max  # motors do not exceed it, whatever the command
            tau = np.clip(tau, -tau_max, tau_max)
        self._estimator.answer(stamp_to_ns(message.header.stamp), tau)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        config, estimator, reader = self._config, self._estimator, self._reader
        self._period.compare(reader)
        values: dict[str, Any] = {
            "velocity_estimation": config.velocity_estimation,
            "delay_periods": config.declared.delay,
            "motor_lag_s": config.declared.motor_lag,
            "states_answered": self._answered,
            "states_refused": reader.refused,
            "commands_heard": self.commands_heard,
            "commands_refused": self._refused,
            "payload": str(self._payload.payload),
            "payload_refused": self._payload.refused,
            "resets": estimator.resets,
            "age_s": time.monotonic() - reader.heard_at,
        }
        if (design := self._observers) is not None:
            values |= {
                "position_error_rad": design.position_error,
                "velocity_error_rad_s": design.velocity_error,
                "innovation_declared_rad": design.innovation,
                "innovation_max_rad": estimator.innovation,
            }
        if reader.stamp < 0:
            return DiagnosticStatus.WARN, "no joint state yet", values
        if reader.refused:
            return DiagnosticStatus.WARN, "joint states were refused", values
        if estimator.resets:
            return DiagnosticStatus.WARN, "started anew since the start", values
        if design is not None and config.declared.position_error.any():
            over = estimator.innovation > design.innovation
            if over.any():
                joint = self._joints[int(np.argmax(over))]
                return DiagnosticStatus.WARN, f"errors of {joint} larger than declared", values
        return DiagnosticStatus.OK, "answering", values


def main(args: list[str] | None = None) -> int:
    """Run the estimator node until it is told to stop."""
    return run(EstimatorNode, args)


if __name__ == "__main__":
    sys.exit(main())
