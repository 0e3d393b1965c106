# SPDX-License-Identifier: Apache-2.0
"""Collision avoidance as constraints on joint accelerations: distances that can always be kept.

`docs/collision_avoidance.md` derives the rows, and says what they promise and what not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.collision.kernels import (
    RESERVE,
    CollisionRows,
    DistanceLimits,
    JointBounds,
    Workspace,
    collision_rows,
)
from torque_safety_controller.collision.kinematics import Kinematics
from torque_safety_controller.collision.model import CollisionModel
from torque_safety_controller.qp.constraints import AccelerationRange, LinearConstraints
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.kernel.one_sided_limit import JointTable, make_table
from viability_bounds_pkg.parameter import Range, above, check, number

Array = NDArray[np.float64]

ROW_SCALE = 0.01
"""Of rows in the QP: where they, the torques and the joints' bounds have no common solution, a
distance gives way at a ten thousandth of what joints cost, so that the joints keep theirs."""

INFLUENCE = 0.08
"""Distance beyond the margin at which pairs are looked at that do not approach fast, m."""

# Of the virtual joint, whose braking is 1: more than anything has.
_FAST, _HARD = 1e6, 1e12


@dataclass(frozen=True)
class CollisionSettings:
    """What distances are kept, and how.

    Attributes:
        braking: deceleration that a distance counts on at most, m/s^2.

    Raises:
        SettingError: a value is out of range; named as the node's parameters.
    """

    margin: float = number(
        "distance kept between links and to obstacles, m", Range(0.0, 0.5), default=0.02
    )
    speed_max: float = number("largest speed of approach, m/s", above(0.0, 10.0), default=1.0)
    braking: float = 2.0

    def __post_init__(self) -> None:
        check(self, "collision_")
        if not (math.isfinite(self.braking) and self.braking > 0.0):
            raise SettingError("collision_braking", self.braking, "a finite number > 0")

    @property
    def kept(self) -> float:
        """Margin and reserve, m."""
        return self.margin + RESERVE


class CollisionAvoidance:
    """Rows that keep the pairs of a collision model apart.

    Args:
        model: shapes and pairs.
        a_min: acceleration limits of the joints, shape (n,), rad/s^2, negative.
        a_max: shape (n,), rad/s^2, positive.
        dt: how long an acceleration is held, s; more than the control period gives gentler
            rows, as with the joints' bounds.
        settings: distances and speeds.
        rows_max: how many rows a step returns at most; of more, those of the least distances.
            Only arms deep in obstacles have more, and a QP needs an end.

    Attributes:
        model, settings: as given.
        count: how many rows the last step had, before those beyond `rows_max` were dropped.

    Raises:
        SettingError: limits of the wrong size or sign, or a step that is not positive.
    """

    def __init__(
        self,
        model: CollisionModel,
        a_min: ArrayLike,
        a_max: ArrayLike,
        dt: float,
        settings: CollisionSettings | None = None,
        rows_max: int = 40,
    ) -> None:
        n = model.arm.nv
        lower, upper = np.asarray(a_min, dtype=np.float64), np.asarray(a_max, dtype=np.float64)
        for name, limit, sign in (("min", lower, -1.0), ("max", upper, 1.0)):
            if limit.shape != (n,) or not (np.isfinite(limit) & (sign * limit > 0.0)).all():
                kind = "negative" if sign < 0.0 else "positive"
                raise SettingError(f"acceleration_{name}", limit, f"{n} finite {kind} numbers")
        if not (math.isfinite(dt) and dt > 0.0):
            raise SettingError("dt", dt, "a finite number > 0")
        if rows_max < 1:
            raise SettingError("rows_max", rows_max, "positive")
        self.model = model
        self.settings = settings = settings or CollisionSettings()
        self.count = 0
        self._rows_max = rows_max
        self._undisturbed = np.zeros(n)
        self._braking = np.minimum(-lower, upper)
        self._kinematics = Kinematics(model.arm, len(model.bodies.joint))
        parts, pairs = np.diff(model.bodies.first), model.pairs
        most = int((parts[pairs.first] + parts[pairs.second]).sum())
        self._work = Workspace(
            model.bodies,
            pairs,
            self._kinematics.motion,
            DistanceLimits(
                kept=settings.kept,
                braking=settings.braking,
                speed_max=settings.speed_max,
                influence=settings.margin + INFLUENCE,
                dt=dt,
            ),
            _virtual_joint(dt),
            CollisionRows(
                G=np.zeros((most + 1, n)),
                lower=np.zeros(most),
                pair=np.zeros(most, dtype=np.int64),
                distance=np.zeros(most),
                rate=np.zeros(most),
                bias=np.zeros(most),
                viable=np.zeros(most, dtype=bool),
            ),
            distances=np.full(len(model.names), np.inf),
            seen=np.zeros((16, 2, 3)),
        )
        # The first call compiles; let it be this one and not one in a control loop.
        self.rows(np.zeros(n), np.zeros(n), lower, upper)

    def rows(
        self,
        q: Array,
        v: Array,
        a_lower: Array,
        a_upper: Array,
        disturbance: Array | None = None,
    ) -> CollisionRows:
        """Return the rows of one step, overwritten by the next; those that bounds imply are not.

        Args:
            q: shape (n,), rad.
            v: shape (n,), rad/s.
            a_lower: bounds of the accelerations, shape (n,), rad/s^2, finite.
            a_upper: shape (n,), rad/s^2, not below `a_lower`.
            disturbance: what comes on top of the accelerations, shape (n,), rad/s^2. What of it
                takes distance away is asked for in addition, as in `DisturbanceObserver.shift`.

        Values that are not finite are the caller's to refuse.
        """
        chosen = self._update(q, v, a_lower, a_upper, disturbance)
        return CollisionRows._make([array[chosen] for array in self._work.rows])

    def _update(
        self, q: Array, v: Array, a_lower: Array, a_upper: Array, disturbance: Array | None
    ) -> slice | NDArray[np.int64]:
        """Compute the rows of a step; return which are to be used."""
        self._kinematics.update(q, v)
        pushed = self._undisturbed if disturbance is None else disturbance
        bounds = JointBounds(a_lower, a_upper, pushed, self._braking)
        self.count = k = collision_rows(v, bounds, self._work)
        if k <= self._rows_max:
            return slice(k)
        nearest = np.argpartition(self._work.rows.distance[:k], self._rows_max)
        return np.sort(nearest[: self._rows_max])

    def constraint(
        self, robot: RobotModel, bounds: AccelerationRange, disturbance: Array | None = None
    ) -> LinearConstraints | None:
        """Return the rows of one step for the QP, in a scale in which bounds are dearer.

        Args:
            robot: updated to the current state, which may be not finite.
            bounds: of the accelerations, may be infinite.
            disturbance: as in `rows`, finite.

        Returns:
            None in a state that is not finite, which the QP refuses.
        """
        q, v = robot.q, robot.v
        a_lower, a_upper = bounds
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return None
        # Infinite, or for the QP to refuse.
        if not (np.isfinite(a_lower).all() and np.isfinite(a_upper).all()):
            a_lower, a_upper = (
                np.nan_to_num(bound, posinf=_FAST, neginf=-_FAST) for bound in (a_lower, a_upper)
            )
        chosen, rows = self._update(q, v, a_lower, a_upper, disturbance), self._work.rows
        lower = ROW_SCALE * rows.lower[chosen]
        return LinearConstraints(ROW_SCALE * rows.G[chosen], lower, np.full(len(lower), np.inf))

    @property
    def viable(self) -> bool:
        """Whether all rows of the last step were viable."""
        return bool(self._work.rows.viable[: self.count].all())

    @property
    def distances(self) -> Array:
        """Distances of all pairs in the last step, shape (p,), m; inf where one is far."""
        return self._work.distances

    def closest(self) -> tuple[float, str]:
        """Return the least distance in the last step, m, and between what; inf if all are far."""
        distance = float(self.distances.min(initial=math.inf))
        if distance == math.inf:
            return distance, ""
        return distance, self.model.names[int(self.distances.argmin())]


def _virtual_joint(dt: float) -> JointTable:
    """Return the table of a joint with a lower limit of 0 and none above, whose braking is 1."""
    return make_table(
        dt=dt, position=[math.inf, 0.0], braking=1.0, v_max=_FAST, low=-_HARD, high=_HARD
    )
