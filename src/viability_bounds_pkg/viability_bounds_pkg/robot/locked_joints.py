# SPDX-License-Identifier: Apache-2.0
"""Joints that a model has locked but that move in life, such as the lift of a torso."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pinocchio as pin

from viability_bounds_pkg.robot.configuration import RobotConfiguration
from viability_bounds_pkg.robot.description import frame_id, posture, tell_apart, whole_model
from viability_bounds_pkg.robot.payload import Payload
from viability_bounds_pkg.robot.urdf_joints import units_of

PERIOD = 0.1
"""Between two looks at the joints, s."""

SLIGHT = 1e-3
"""Change of a position that the model does not follow, rad or m."""

TOLD = 0.01
"""Change of a position that is told, rad or m."""

SPEED = 0.05
"""Speed from which a joint moves, rad/s or m/s; others shake it."""

FASTEST = 5.0
"""Speed from which a position must be seen twice to count, rad/s or m/s; no such joint has it."""

STILL = 0.5
"""How long it is slower before it stands, s."""


class LockedJoints:
    """Keeps a model to where its locked joints are: those before the joints or frames that count.

    Joints on other branches, such as wheels, and those beyond, such as fingers, stay where they
    are locked; and so does the model of positions that are beyond the limits by more than their
    range: they are of another unit.

    Args:
        config: which robot it is.
        urdf: text of its URDF.
        model: of the arm; its placements and masses change with the joints.
        payload: of that model.
        hands: names of the frames that goals move.
        base: name of the frame that goals are given in; empty for the root.

    Attributes:
        moving: name of a joint between base and hands that moves, or has just moved; empty for
            none.
    """

    def __init__(
        self,
        config: RobotConfiguration,
        urdf: str,
        model: pin.Model,
        payload: Payload,
        hands: Sequence[str] = (),
        base: str = "",
    ) -> None:
        self._model, self._payload = model, payload
        full, self._continuous = whole_model(urdf)
        joints = [full.getJointId(name) for name in config.joints]
        arm = _before(full, [*joints, *(_joint_of(full, hand) for hand in hands)])
        root = _before(full, [_joint_of(full, base) if base else 0])
        self._q = posture(full, config.locked)
        self._index = {
            full.names[j]: full.joints[j].idx_q
            for j in sorted((arm | root) - {0, *joints})
            if full.joints[j].nq == 1
        }
        low, high = full.lowerPositionLimit, full.upperPositionLimit
        self._possible = {
            name: (low[k] - width, high[k] + width)
            for name, k in self._index.items()
            for width in [high[k] - low[k] if name not in self._continuous else math.inf]
        }
        self._between = {full.names[j] for j in arm ^ root}
        units = units_of(urdf, list(self._index))
        self._units = dict(zip(self._index, units, strict=True))
        self._locked = [j for j in range(1, full.njoints) if j not in joints]
        tell_apart(full)
        self._full = full
        self._seen: Mapping[str, float] = {}
        self._steady = False
        self._impossible: dict[str, bool] = {}  # whether that was told
        self._told = {name: float(self._q[k]) for name, k in self._index.items()}
        self._stamp = self._moved_at = -math.inf
        self.moving = ""

    def due(self, stamp: int) -> bool:
        """Return whether to look at the joints again at a robot's time, ns."""
        return bool(self._index) and not 0 <= 1e-9 * (stamp - self._stamp) < PERIOD

    def look(self, names: Sequence[str], positions: Sequence[float], stamp: int) -> bool:
        """Look where the joints are, and have the model follow.

        Args:
            names: of joints of a joint state.
            positions: of these, rad or m.
            stamp: of that, ns.

        Returns:
            Whether the model has changed.
        """
        now, elapsed = self._among(names, positions), 1e-9 * (stamp - self._stamp)
        ways = {name: abs(each - self._seen.get(name, each)) for name, each in now.items()}
        for name, way in ways.items():
            if elapsed > 0.0 and way > SPEED * elapsed and name in self._between:
                self.moving, self._moved_at = name, stamp
        if not 0 <= 1e-9 * (stamp - self._moved_at) < STILL:
            self.moving = ""
        self._steady = max(ways.values(), default=0.0) <= SLIGHT
        self._seen, self._stamp = now, stamp
        if any(way > FASTEST * elapsed for way in ways.values()):
            return False
        if all(abs(each - self._q[self._index[name]]) <= SLIGHT for name, each in now.items()):
            return False
        for name, position in now.items():
            self._q[self._index[name]] = position
        self._follow()
        return True

    def _among(self, names: Sequence[str], positions: Sequence[float]) -> dict[str, float]:
        """Return the positions of locked joints; continuous ones in the turn of the model."""
        given = dict(zip(names, positions, strict=False))
        found = {}
        for name, k in self._index.items():
            position = given.get(name, math.nan)
            low, high = self._possible[name]
            if not (math.isfinite(position) and low <= position <= high):
                if name in given:
                    self._impossible.setdefault(name, False)
                continue
            if name in self._continuous:
                here = float(self._q[k])
                position = here + math.remainder(position - here, math.tau)
            found[name] = position
        return found

    def refused(self) -> list[str]:
        """Return whose position is no number, or beyond the range of the joint, a line, once."""
        lines = []
        for name in [name for name, told in self._impossible.items() if not told]:
            self._impossible[name] = True
            lines.append(
                f"the position of {name} is no number, or beyond its limits by more than their "
                f"range: {self._units[name]}? It is not used in the model"
            )
        return lines

    def news(self) -> list[str]:
        """Return where joints stand now that the model goes by, a line each, once."""
        lines = []
        for name, k in self._index.items():
            if self._steady and not self.moving and abs(self._q[k] - self._told[name]) > TOLD:
                self._told[name] = float(self._q[k])
                lines.append(f"{name} at {self._q[k]:.3f} {self._units[name]}: used in the model")
        return lines

    def _follow(self) -> None:
        """Copy what depends on the joints; joints and frames of both models have one order."""
        model, found = self._model, pin.buildReducedModel(self._full, self._locked, self._q)
        for j in range(1, model.njoints):
            model.jointPlacements[j] = found.jointPlacements[j]
        for k in range(len(model.frames)):
            model.frames[k].placement = found.frames[k].placement
        self._payload.rebase(found.inertias)


def _joint_of(model: pin.Model, frame: str) -> int:
    return int(model.frames[frame_id(model, frame)].parentJoint)


def _before(model: pin.Model, joints: Sequence[int]) -> set[int]:
    """Return the joints that move others, these included."""
    return {each for joint in joints for each in model.supports[joint]}
