# SPDX-License-Identifier: Apache-2.0
"""What happens to a robot in a soak: goals, pushes, and faults one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from chain import ROOT
from faults import FAULTS, SENDERS
from moments import Corners
from numpy.typing import NDArray

from torque_safety_controller.node.assembly import load_robot
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.state import State
from viability_bounds_pkg.user_input.parameter_files import read_files

Array = NDArray[np.float64]

BLIND = ("states frozen", "positions frozen", "velocities with a bias")
"""Faults until which are told the arm moves blind: limits may be passed, see docs/faults.md."""
BETWEEN = tuple(name for name in FAULTS if name not in BLIND)
"""Faults between the nodes, of `FAULTS`."""
SHORT, LONG = 0.1, 1.0  # s, of a fault
LEAD = 3.0  # s from the start of the fault node to the first fault
PUSH = 0.3
"""Share of the acceleration limits that a push may take, and that the bounds are told of."""
POSTURES = 300  # of which the weakest decides how strong a push may be


@dataclass(frozen=True)
class Slot:
    """A fault to come.

    Attributes:
        name: what happens: one of `BETWEEN`, or of processes.
        duration: s.
    """

    name: str
    duration: float

    @property
    def between(self) -> bool:
        """Whether the fault node brings it about."""
        return self.name in BETWEEN


def slots(rng: np.random.Generator, count: int, process_faults: tuple[str, ...]) -> list[Slot]:
    """Return faults in random order, so that each kind comes about equally often."""
    kinds = (*BETWEEN, *process_faults)
    names: list[str] = []
    while len(names) < count:
        names += [kinds[k] for k in rng.permutation(len(kinds))]
    return [Slot(name, float(rng.uniform(SHORT, LONG))) for name in names[:count]]


def timeline(planned: list[Slot], every: float) -> str:
    """Return the file of the fault node for faults that come each `every` s from `LEAD` s on."""
    lines = [f"topics: [{', '.join(SENDERS)}]", "faults:"]
    for k, slot in enumerate(planned):
        if slot.between:
            topic, what, *_ = FAULTS[slot.name]
            when = f"time: {LEAD + k * every:.3f}, duration: {slot.duration:.3f}"
            lines.append(f"  - {{{when}, topic: {topic}, {what}}}")
    return "\n".join(lines) + ("\n" if len(lines) > 2 else " []\n")


class Arm:
    """The model of a robot: its goals, and how strong pushes may be.

    Args:
        robot: name of its file.
        rng: random numbers.

    Attributes:
        config: of its controller.
        force: of a push at the end effector, in any direction, N.
        disturbance: acceleration that it causes at most, shape (n,), rad/s^2.
    """

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        path = ROOT / "config" / f"{robot}.yaml"
        self.config = read_files(ControllerConfiguration, [path], "/**/controller_node")
        loaded = load_robot(self.config)
        self._model, self._base = loaded.robot, loaded.base
        self._rng = rng
        values = {name: getattr(self.config, name) for name in ("position_min", "position_max")}
        self._corners = Corners(values, rng)
        limits = self.config.collision
        weakest = np.minimum(-limits.acceleration_min, limits.acceleration_max)
        per_newton = np.max([self._per_newton(self._posture()) for _ in range(POSTURES)], axis=0)
        self.force = float((PUSH * weakest / per_newton).min())
        self.disturbance: Array = self.force * per_newton

    def _posture(self) -> Array:
        low = np.maximum(self.config.position_min, -np.pi)
        high = np.minimum(self.config.position_max, np.pi)
        return self._rng.uniform(low, high)

    def _per_newton(self, q: Array) -> Array:
        """Return the largest accelerations that a force of 1 N at the hand causes, rad/s^2."""
        robot = self._model
        robot.update(State(q, np.zeros_like(q)), np.zeros_like(q))
        caused = np.linalg.solve(robot.M, robot.J[:3].T)
        return np.linalg.norm(caused, axis=1)

    def pose(self, q: Array) -> pin.SE3:
        """Return the pose of the hand at `q`, shape (n,), rad, in the base frame."""
        robot = self._model
        robot.update(State(q, np.zeros_like(q)), np.zeros_like(q))
        return self._base.actInv(robot.pose)

    def goal(self) -> tuple[Array, bool]:
        """Return the joints of a goal, shape (n,), rad, and whether it is one for the hand."""
        if self._rng.random() < 0.5:
            return self._posture(), True
        return self._corners.draw(), False

    def push(self) -> Array:
        """Return a force in a random direction, shape (3,), N."""
        direction = self._rng.normal(size=3)
        return self.force / np.linalg.norm(direction) * direction
