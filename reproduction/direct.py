# SPDX-License-Identifier: Apache-2.0
"""Robot, bounds and controller of a parameter file in one loop, without messages between them.

The same classes, made from the same parameters as in the nodes, step by step in lockstep; for
runs in which something is to happen at an exact step, and for many of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pinocchio as pin
from chain import load_node_values

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.sensor import ForceTorqueReading
from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from torque_safety_controller.node import assembly
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.contact.interaction import Interaction
from torque_safety_controller.parts.integral import FadingTorque, Integral
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.step import Step
from torque_safety_controller.supervisor import Order
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.state import State
from viability_bounds_pkg.stop import CoordinatedStop

Configuration = TypeVar("Configuration")


class Sample(NamedTuple):
    """One control step: state, torque, and what the controller thought."""

    t: float
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    additional: np.ndarray
    error: np.ndarray


class DirectLoop:
    """An arm under control, and the record of what it did.

    Args:
        robot: name of a file in ``config/``.
        changed: parameters that differ from it, by name.

    Attributes:
        robot: in PyBullet.
        controller: with its goals at the start pose.
        declared: of the robot, for the bounds node.
        bounds: of the accelerations in a state (q, v).
        samples: one a control step.
        sensing: whether the force/torque sensor says anything.
    """

    def __init__(self, robot: str, changed: Mapping[str, Any] | None = None) -> None:
        self._values = load_node_values(robot)
        self._changed = dict(changed or {})
        config = self._configuration("bullet_node", BulletConfiguration)
        self.robot = make_robot(config)
        self.robot.monitor = LimitMonitor.of(config)
        self.config = config
        self.model = load_model(config, config.urdf)
        bounds = self.declared = self._configuration("bounds_node", BoundsConfiguration)
        self.limits = bounds.limits
        self.bounds = make_bounds(bounds)
        self.controller, *_ = assembly.make_controller(
            self._controller_configuration(), declared=bounds
        )
        self.sensing = True
        self._sensor = None
        interaction = self.controller.find(Interaction)
        if self.robot.sensor and interaction is not None:
            self._sensor = ForceTorqueReading(
                self.robot.sensor, config.sensor, config.imperfections.imperfection_seed
            )
        self.samples: list[Sample] = []
        self.t = 0.0
        self.robot.reset(config.start_positions, np.zeros(len(config.joints)))
        self.begin()

    def _configuration(self, node: str, kind: type[Configuration]) -> Configuration:
        """Return a node's configuration as it would get it from the file."""
        return read(kind, self._values[node] | self._changed)

    def _controller_configuration(self) -> ControllerConfiguration:
        """Return what the controller node would be made of."""
        return self._configuration("controller_node", ControllerConfiguration)

    def change(self, **parameters: Any) -> None:
        """Change live parameters of the controller, as a running node would."""
        self._changed |= parameters
        self.controller.configure(self._controller_configuration().settings)

    @property
    def integral_budget(self) -> np.ndarray:
        """Budget of the integral action by the parameters, shape (n,), N m."""
        return self._controller_configuration().integral_settings.budget

    def change_integral(self, **settings: Any) -> None:
        """Change settings of the integral action, also those that are no parameters."""
        self.integral.settings = replace(self.integral.settings, **settings)

    @property
    def integral(self) -> FadingTorque:
        """Integral action of the controller."""
        return self.controller.find(Integral).action

    @property
    def dt(self) -> float:
        """Control period, s."""
        return self.config.dt

    def begin(self) -> None:
        """Make where the arm is its goal, and forget the past."""
        q = self.robot.state().q
        self.controller.reset(q)
        self.controller.goals.set_posture(q)
        self.controller.goals.set_pose(self.pose())
        for k, hand in enumerate(self.controller.robot.others):
            self.controller.goals.set_other_pose(k, self.pose(hand.frame))

    def pose(self, frame: str = "") -> pin.SE3:
        """Return the true pose of a frame, the end effector if empty, in the URDF's root frame."""
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, self.robot.state().q)
        return data.oMf[self.model.getFrameId(frame or self.controller.robot.frame)].copy()

    def run(
        self, duration: float, each: Callable[[float], None] | None = None
    ) -> tuple[Sample, ...]:
        """Play on for some seconds; return the samples.

        Args:
            duration: s.
            each: called with the time before each step.
        """
        first = len(self.samples)
        for _ in range(round(duration / self.dt)):
            if each is not None:
                each(self.t)
            self.step()
        return tuple(self.samples[first:])

    def step(self, order: Order | None = None) -> Step:
        """Play one control step under torque control, by an order of the supervisor."""
        q, v, _ = self.robot.state()
        if self._sensor is not None and self.sensing:
            self.controller.find(Interaction).sensor.receive(self._sensor.read())
        bounds = self.bounds(q, v)
        limits = AccelerationRange(bounds.lower, bounds.upper)
        step = self.controller.step(State(q, v), limits, order)
        self._record(q, v, step.tau)
        self.robot.step(step.tau, self.config.substeps)
        return step

    def move(self, q_des: np.ndarray) -> None:
        """Play one control step under position control by the robot's drives."""
        q, v, _ = self.robot.state()
        config = self.config
        self.robot.move(
            q_des, np.zeros(q.size), config.torque_max, config.velocity_max, config.substeps
        )
        self._record(q, v, self.robot.state().motor_torque)

    def act(self, law: CoordinatedStop, tau: np.ndarray, missed_in_row: int) -> None:
        """Play the robot's part of a period as its node does where commands may be missing.

        Args:
            law: by which the robot stops itself.
            tau: the last command, shape (n,), N m.
            missed_in_row: for how many periods none has come.
        """
        if missed_in_row > self.config.command_timeout:
            self.robot.stop(law, self.config.substeps)
        elif missed_in_row or self.robot.returning:
            self.robot.follow(law, tau, self.config.substeps)
        else:
            self.robot.step(tau, self.config.substeps)

    def resume(self, q_des: np.ndarray) -> None:
        """Prepare torque control in a step that is still the drives'."""
        q, v, tau = self.robot.state()
        bounds = self.bounds(q, v)
        self.controller.resume(State(q, v), AccelerationRange(bounds.lower, bounds.upper), tau)
        self.move(q_des)

    def _record(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
        self.samples.append(
            Sample(
                self.t,
                q,
                v,
                tau.copy(),
                self.integral.last.copy(),
                self.controller.goals.error(self.controller.robot.pose),
            )
        )
        self.t += self.dt


def posture_at_limits(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a random posture with about 6 of 10 joints at a limit, shape (n,), rad."""
    goal, side = rng.uniform(low, high), rng.random(low.size)
    return np.where(side < 0.3, low, np.where(side < 0.6, high, goal))


def column(samples: tuple[Sample, ...], name: str) -> np.ndarray:
    """Return one field of all samples as an array."""
    return np.array([getattr(sample, name) for sample in samples])


def hand_places(loop: DirectLoop, samples: tuple[Sample, ...]) -> np.ndarray:
    """Return where the hand was, shape (N, 3), m."""
    data = loop.model.createData()
    frame = loop.model.getFrameId(loop.controller.robot.frame)
    places = np.empty((len(samples), 3))
    for k, sample in enumerate(samples):
        pin.framesForwardKinematics(loop.model, data, sample.q)
        places[k] = data.oMf[frame].translation
    return places


def hand_errors(samples: Sequence[Sample]) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the hand was off its goal at each step, m and rad, shape (N,) each."""
    error = column(tuple(samples), "error")
    return np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)


def distance(samples: tuple[Sample, ...]) -> np.ndarray:
    """Return the distance of the hand from its goal at each step, m."""
    return hand_errors(samples)[0]


def within_limits(loop: DirectLoop) -> bool:
    """Return whether no joint passed a limit of position, speed or torque in the simulator."""
    return not loop.robot.monitor.violated
