# SPDX-License-Identifier: Apache-2.0
"""Collision avoidance as constraints on joint accelerations: distances that can always be kept.

`docs/collision_avoidance.md` derives the rows, and says what they promise and what not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.collision.model import CollisionModel
from torque_safety_controller.collision.motion import Kinematics
from torque_safety_controller.collision.rows import (
    RESERVE,
    CollisionRows,
    Workspace,
    collision_rows,
)
from torque_safety_controller.qp import AccelerationRange, LinearConstraints
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.compiled import bound
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.kernel import make_table
from viability_bounds_pkg.parameter import Range, check, number

Array = NDArray[np.float64]

ROW_SCALE = 0.01
"""Of rows in the QP: where they, the torques and the joints' bounds have no common solution, a
distance gives way at a ten thousandth of what joints cost, so that the joints keep theirs."""

INFLUENCE = 0.08
"""Distance beyond the margin at which pairs are looked at that do not approach fast, m."""

ROWS_MAX = 40
"""Rows that a step returns at most; of more, those of the least distances. Only arms deep in
obstacles have more, and a QP needs an end."""

SPEED_MAX = 1.0
"""Largest speed of approach, m/s."""

# Of a virtual joint whose braking is 1: more than anything has.
_FAST, _HARD = 1e6, 1e12


@dataclass(frozen=True)
class CollisionSettings:
    """What distances are kept, and how.

    Raises:
        SettingError: a value is out of range; named as the node's parameters.
    """

    margin: float = number(
        "distance kept between links and to obstacles, m", Range(0.0, 0.5), default=0.02
    )

    def __post_init__(self) -> None:
        check(self, "collision_")

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

    Attributes:
        model, settings: as given.
        count: how many rows the last step had, before those beyond `ROWS_MAX` were dropped.

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
    ) -> None:
        n = model.arm.nv
        lower, upper = np.asarray(a_min, dtype=np.float64), np.asarray(a_max, dtype=np.float64)
        for name, limit, sign in (("min", lower, -1.0), ("max", upper, 1.0)):
            if limit.shape != (n,) or not (np.isfinite(limit) & (sign * limit > 0.0)).all():
                kind = "negative" if sign < 0.0 else "positive"
                raise SettingError(f"acceleration_{name}", limit, f"{n} finite {kind} numbers")
        if not 0.0 < dt < math.inf:
            raise SettingError("dt", dt, "a finite number > 0")
        self.model = model
        self.settings = settings = settings or CollisionSettings()
        self.count = 0
        self._rows_max = ROWS_MAX
        self._kinematics = Kinematics(model.arm, len(model.bodies.joint))
        parts, pairs = np.diff(model.bodies.first), model.pairs
        most = int((parts[pairs.first] + parts[pairs.second]).sum())
        self._no_limit = np.full(most, np.inf)
        v, a_lower, a_upper, disturbance = np.zeros((4, n))
        # Of a joint with a lower limit of 0 and none above, whose braking is 1.
        table = make_table(
            dt=dt, position=[math.inf, 0.0], braking=1.0, v_max=_FAST, low=-_HARD, high=_HARD
        )
        self._use(
            Workspace(
                model.bodies,
                pairs,
                self._kinematics.motion,
                kept=settings.kept,
                speed_max=SPEED_MAX,
                influence=settings.margin + INFLUENCE,
                dt=float(dt),
                table=table,
                braking=np.minimum(-lower, upper),
                v=v,
                a_lower=a_lower,
                a_upper=a_upper,
                disturbance=disturbance,
                rows=CollisionRows(
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
        )

    def _use(self, work: Workspace) -> None:
        self._work, self._find_rows = work, bound(collision_rows, work)

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
        work = self._work
        self._kinematics.update(q, v)
        work.v[:], work.a_lower[:], work.a_upper[:] = v, a_lower, a_upper
        work.disturbance[:] = 0.0 if disturbance is None else disturbance
        self.count = k = self._find_rows()
        chosen: slice | NDArray[np.int64] = slice(k)
        if k > self._rows_max:
            nearest = np.argpartition(work.rows.distance[:k], self._rows_max)
            chosen = np.sort(nearest[: self._rows_max])
        return CollisionRows._make([array[chosen] for array in work.rows])

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
        if not math.isfinite(q.dot(q) + v.dot(v)):
            return None
        # Infinite, or for the QP to refuse.
        if not math.isfinite(a_lower.dot(a_lower) + a_upper.dot(a_upper)):
            a_lower, a_upper = (
                np.nan_to_num(limit, posinf=_FAST, neginf=-_FAST) for limit in (a_lower, a_upper)
            )
        rows = self.rows(q, v, a_lower, a_upper, disturbance)
        lower = ROW_SCALE * rows.lower
        return LinearConstraints(ROW_SCALE * rows.G, lower, self._no_limit[: len(lower)])

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
