"""Collision avoidance as rows on joint accelerations: distances that can be kept for ever.

`docs/collision_avoidance.md` derives the rows, and says what they promise and what not.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.collision.kernels import ROWS_OF_KIND, collision_rows
from torque_safety_controller.collision.kinematics import make_motion
from torque_safety_controller.collision.model import CollisionModel
from torque_safety_controller.collision.obstacles import CollisionError
from torque_safety_controller.collision.row import Law, Step, make_rows
from torque_safety_controller.qp.constraints import AccelerationRange, LinearConstraints
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.kernel.one_sided_limit import make_table

Array = NDArray[np.float64]

ROW_SCALE = 0.01
"""Of rows in the QP: where they, the torques and the joints' bounds have no common solution, a
distance gives way at a ten thousandth of what joints cost, so that the joints keep theirs."""

# Of the virtual joint, whose braking is 1: more than anything has.
_FAST, _HARD = 1e6, 1e12


@dataclass(frozen=True)
class CollisionSettings:
    """What distances are kept, and how.

    Attributes:
        margin: distance to keep, m.
        reserve: kept on top of it, m; what the linearisation within a step may take.
        braking: deceleration that a distance counts on at most, m/s^2.
        braking_share: share of what the joints can do along a distance that it counts on, up
            to `braking`.
        speed_max: greatest speed of approach, m/s.
        recovery_speed: speed at which bodies inside the margin are parted, m/s.
        influence: distance beyond which a pair is not looked at, m, unless it approaches fast.
    """

    margin: float = 0.02
    reserve: float = 0.002
    braking: float = 2.0
    braking_share: float = 0.3
    speed_max: float = 1.0
    recovery_speed: float = 0.1
    influence: float = 0.1

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0.0):
                raise CollisionError(f.name, value, "a finite number >= 0")
            if value == 0.0 and f.name not in ("margin", "reserve"):
                raise CollisionError(f.name, value, "a finite number > 0")
        if self.braking_share > 1.0:
            raise CollisionError("braking_share", self.braking_share, "at most 1")
        if self.influence <= self.margin + self.reserve:
            raise CollisionError("influence", self.influence, "more than margin and reserve")


class CollisionRows(NamedTuple):
    """Rows ``G a >= lower``; arrays are views that the next step overwrites.

    Attributes:
        G: shape (k, n), m/rad.
        lower: shape (k,), m/s^2; never more than some `a` within the bounds reaches.
        names: of the bodies of each row, length k.
        distance: shape (k,), m; negative where capsules overlap.
        rate: rate of change of the distance, shape (k,), m/s.
        bias: its acceleration at zero joint acceleration, shape (k,), m/s^2, so that its
            acceleration is ``G a + bias``.
        viable: shape (k,), bool; False where the margin is broken, or more braking is needed to
            keep it than is counted on or than the bounds allow.
    """

    G: Array
    lower: Array
    names: list[str]
    distance: Array
    rate: Array
    bias: Array
    viable: NDArray[np.bool_]


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

    Raises:
        CollisionError: limits of the wrong size or sign, or a step that is not positive.
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
        n = len(model.chain.parent) - 1
        lower, upper = np.asarray(a_min, dtype=float), np.asarray(a_max, dtype=float)
        for name, limit, sign in (("a_min", lower, -1.0), ("a_max", upper, 1.0)):
            if limit.shape != (n,) or not (np.isfinite(limit) & (sign * limit > 0.0)).all():
                kind = "negative" if sign < 0.0 else "positive"
                raise CollisionError(name, limit, f"{n} finite {kind} numbers")
        if not (math.isfinite(dt) and dt > 0.0):
            raise CollisionError("dt", dt, "a finite number > 0")
        if rows_max < 1:
            raise CollisionError("rows_max", rows_max, "positive")
        self._rows_max = rows_max
        self.settings = settings or CollisionSettings()
        self.model = model
        table = make_table(
            dt=dt,
            position=[math.inf, 0.0],
            braking=1.0,
            v_max=_FAST,
            low=-_HARD,
            high=_HARD,
        )
        most = int(ROWS_OF_KIND[model.pairs.kind].sum()) + 1
        self._count = 0
        self._undisturbed = np.zeros(n)
        self._rows = make_rows(most, n, len(model.names), len(model.bodies.joint))
        self._fixed = (
            np.minimum(-lower, upper),
            *table,
            Law(*astuple(self.settings), dt),
        )
        self._arm = (model.chain, make_motion(model.chain), self._rows)
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
        """Return the rows of one step; those that the bounds imply are left out.

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
        rows, names = self._rows, self.model.names
        return CollisionRows(
            rows.G[chosen],
            rows.lower[chosen],
            [names[i] for i in rows.pair[chosen].tolist()],
            rows.distance[chosen],
            rows.rate[chosen],
            rows.bias[chosen],
            rows.viable[chosen],
        )

    def _update(self, q, v, a_lower, a_upper, disturbance) -> slice | NDArray[np.int64]:
        """Compute the rows of a step; return which are to be used."""
        pushed = self._undisturbed if disturbance is None else disturbance
        step = Step(a_lower, a_upper, pushed, *self._fixed)
        k = collision_rows(q, v, self.model.pairs, self.model.bodies, step, *self._arm)
        self._count = k
        if k <= self._rows_max:
            return slice(k)
        nearest = np.argpartition(self._rows.distance[:k], self._rows_max)
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
        chosen = self._update(q, v, a_lower, a_upper, disturbance)
        G, lower = self._rows.G[chosen], self._rows.lower[chosen]
        return LinearConstraints(ROW_SCALE * G, ROW_SCALE * lower, np.full(len(lower), np.inf))

    @property
    def count(self) -> int:
        """How many rows the last step had, before those beyond `rows_max` were dropped."""
        return self._count

    @property
    def viable(self) -> bool:
        """Whether all rows of the last step were viable."""
        return bool(self._rows.viable[: self._count].all())

    @property
    def distances(self) -> Array:
        """Distances of all pairs in the last step, shape (p,), m; inf where one is far."""
        return self._rows.found

    def closest(self) -> tuple[float, str]:
        """Return the least distance in the last step, m, and between what; inf if all are far."""
        if not self.model.names:
            return math.inf, ""
        index = int(np.argmin(self._rows.found))
        distance = float(self._rows.found[index])
        return distance, self.model.names[index] if distance < math.inf else ""
