# SPDX-License-Identifier: Apache-2.0
"""Keeps links apart from each other and from obstacles, by constraints on joint accelerations.

`docs/guides/collision.md` derives the rows, and says what they promise and what not.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.parts.collision.distances import find_features, move_segments
from torque_safety_controller.parts.collision.model import CollisionModel
from torque_safety_controller.parts.collision.rows import BRAKING, RESERVE, SPEED_MAX, write_rows
from torque_safety_controller.qp import LinearConstraints
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Step

Array = NDArray[np.float64]

ROW_SCALE = 0.01
"""Of rows in the QP: where they, the torques and the joints' bounds have no common solution, a
distance gives way at a ten thousandth of what joints cost, so that the joints keep theirs."""

MARGIN = 0.02
"""Distance kept between links and to obstacles, m."""

INFLUENCE = 0.08
"""Distance beyond the margin within which pairs matter that do not approach fast, m."""

ROWS_MAX = 40
"""Rows that a step returns at most; of more, those of the least distances. Only arms deep in
obstacles have more, and a QP needs an end."""

_UNBOUNDED = 1e6  # rad/s^2; more than anything has
_SLIGHT = 1e-3  # m; violations of the margin below this are not reported


class CollisionRows(NamedTuple):
    """Rows ``G a >= lower``.

    Attributes:
        G: shape (k, n), m/rad.
        lower: shape (k,), m/s^2; never more than some `a` within the bounds reaches.
        pair: index of the pair that a row belongs to, shape (k,), int.
        distance: shape (k,), m; negative where bodies overlap.
        rate: rate of change of the distance, shape (k,), m/s.
        bias: its acceleration at zero joint acceleration, shape (k,), m/s^2, so that its
            acceleration is ``G a + bias``.
        viable: shape (k,), bool; False where the margin is broken, or more braking is needed to
            keep it than is counted on or than the bounds allow.
    """

    G: Array
    lower: Array
    pair: NDArray[np.int64]
    distance: Array
    rate: Array
    bias: Array
    viable: NDArray[np.bool_]


class Collision(Part):
    """Adds rows to a step that keep the pairs of a collision model apart for ever.

    Args:
        model: shapes and pairs.
        a_min: acceleration limits of the joints, shape (n,), rad/s^2, negative.
        a_max: shape (n,), rad/s^2, positive.
        dt: how long an acceleration is held, s; more than the control period gives gentler
            rows, as with the joints' bounds.

    Attributes:
        model, dt: as given.
        margin: distance that is kept, m.
        influence: distance within which pairs matter that do not approach fast, m.
        speed_max: largest speed of approach, m/s.
        rows_max: rows that a step returns at most.
        count: how many rows the last step had, before those beyond `rows_max` were dropped.
        distances: of all pairs in the last step, shape (p,), m; inf where one is far.
    """

    def __init__(
        self,
        model: CollisionModel,
        a_min: ArrayLike,
        a_max: ArrayLike,
        dt: float,
    ) -> None:
        self.model, self.dt, self.margin = model, dt, MARGIN
        self.influence, self.speed_max = MARGIN + INFLUENCE, SPEED_MAX
        self.rows_max, self.count = ROWS_MAX, 0
        self.distances = np.full(len(model.names), np.inf)
        n, joints, most = model.arm.nv, model.arm.njoints, len(model.candidates.bodies)
        self._data = data = model.arm.createData()
        self._parent = np.array(list(model.arm.parents), dtype=np.int64)
        self._J, self._dJ = data.J.T, data.dJ.T  # views of Pinocchio's memory, like those below
        # To read each placement anew takes ten times as long.
        self._views = [
            view
            for m in range(joints)
            for view in (data.oMi[m].rotation, data.oMi[m].translation[None])
        ]
        self._placements = np.zeros((joints, 4, 3))
        self._twists = np.zeros((joints, 2, 6))
        self._points = np.zeros((len(model.segments.joint), 2, 3, 3))
        self._limits = np.zeros((4, n))
        self._limits[0] = np.minimum(-np.asarray(a_min), a_max)
        # A row more than there are distances: what is not kept is written, too.
        self._pair = np.zeros(most + 1, dtype=np.int64)
        self._line, self._motion = np.zeros((most + 1, 6)), np.zeros((most + 1, 3))
        self._G, self._lower = np.zeros((most + 1, n)), np.zeros(most + 1)
        self._source = np.zeros(most + 1, dtype=np.int64)
        self._viable = np.zeros(most + 1, dtype=bool)
        self._relaxed_steps = self._not_viable_steps = 0
        self._trouble = ""

    def remodel(self, robot: RobotModel) -> None:
        """Place the shapes anew, those on links that the arm does not move as well."""
        self.model.place()

    def reset(self, robot: RobotModel) -> None:
        """Count steps from here on."""
        self._relaxed_steps = self._not_viable_steps = 0
        self._trouble = ""

    def prepare(self, step: Step) -> None:
        """Add rows to a step, in a scale in which bounds are dearer.

        A disturbance makes them only stricter. There are none in a state that is not finite, which
        the QP refuses.
        """
        q, v, e = step.robot.q, step.robot.v, step.disturbance
        if not math.isfinite(q.dot(q) + v.dot(v)):
            return
        # Infinite, or NaN, which is for the QP to refuse.
        lower, upper = np.fmin(np.fmax(step.commanded(step.bounds), -_UNBOUNDED), _UNBOUNDED)
        rows = self.rows(q, v, lower, upper, e)
        if k := len(rows.lower):
            G = ROW_SCALE * rows.G
            step.rows[self] = LinearConstraints(
                G, ROW_SCALE * rows.lower + G @ e, np.full(k, np.inf)
            )

    def learn(self, step: Step) -> None:
        """Count steps whose distances gave way, or cannot be kept for ever."""
        relaxed = step.relaxation_of(self)
        self._relaxed_steps += relaxed is not None and bool(relaxed.any())
        self._not_viable_steps += not self.viable
        (distance, pair), margin = self.closest(), self.margin
        if distance < margin - _SLIGHT:
            self._trouble = f"{pair}: nearer than {margin:g} m, moving out"
        elif distance >= margin:
            self._trouble = ""

    def rows(
        self,
        q: Array,
        v: Array,
        a_lower: Array,
        a_upper: Array,
        disturbance: Array | None = None,
    ) -> CollisionRows:
        """Return the rows of one step, valid until the next; those that bounds imply are not.

        Args:
            q: shape (n,), rad.
            v: shape (n,), rad/s.
            a_lower: bounds of the accelerations, shape (n,), rad/s^2, finite.
            a_upper: shape (n,), rad/s^2, not below `a_lower`.
            disturbance: what comes on top of the accelerations, shape (n,), rad/s^2. What of it
                takes distance away is asked for in addition, as in `Step.commanded`.

        Values that are not finite are the caller's to refuse.
        """
        arm, segments = self.model.arm, self.model.segments
        features = self._pair, self._line, self._motion
        kept, dt = self.margin + RESERVE, self.dt
        pin.computeJointJacobiansTimeVariation(arm, self._data, q, v)
        np.concatenate(self._views, out=self._placements.reshape(-1, 3))
        move_segments(
            v, self._parent, self._placements, self._J, self._dJ, segments.joint, segments.ends,
            self._twists, self._points,
        )  # fmt: skip
        count = find_features(
            segments.radius, segments.boxes, *self.model.candidates, self._points, self.influence,
            kept, dt, BRAKING, self.distances, *features,
        )  # fmt: skip
        self._limits[1], self._limits[2] = a_lower, a_upper
        self._limits[3] = 0.0 if disturbance is None else disturbance
        self.count = k = write_rows(
            count, *features, self.model.moves, self._J, self._limits, kept, dt, self.speed_max,
            self._G, self._lower, self._source, self._viable,
        )  # fmt: skip
        chosen: slice | NDArray[np.int64] = slice(k)
        if k > self.rows_max:
            distances = self._motion[self._source[:k], 0]
            chosen = np.sort(np.argpartition(distances, self.rows_max)[: self.rows_max])
        source = self._source[chosen]
        distance, rate, bias = self._motion[source].T
        return CollisionRows(
            G=self._G[chosen],
            lower=self._lower[chosen],
            pair=self._pair[source],
            distance=distance,
            rate=rate,
            bias=bias,
            viable=self._viable[chosen],
        )

    @property
    def viable(self) -> bool:
        """Whether all rows of the last step were viable."""
        return bool(self._viable[: self.count].all())

    def closest(self) -> tuple[float, str]:
        """Return the least distance in the last step, m, and between what; inf if all are far."""
        distance = float(self.distances.min(initial=math.inf))
        if distance == math.inf:
            return distance, ""
        return distance, self.model.names[int(self.distances.argmin())]

    @property
    def trouble(self) -> str:
        """Which pair is nearer than the margin."""
        return self._trouble

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        distance, pair = self.closest()
        return {
            "closest_distance_m": distance,
            "closest_pair": pair or "none",
            "collision_pairs": len(self.model.names),
            "collision_rows": self.count,
            "collision_viable": self.viable,
            "collision_not_viable_steps": self._not_viable_steps,
            "collision_relaxed_steps": self._relaxed_steps,
        }
