# SPDX-License-Identifier: Apache-2.0
"""What an arm carries besides its own links: a body on one of them, as a part of its model."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.robot.mistakes import moments_slack, shown_moments

Array = NDArray[np.float64]

FARTHEST = 1.0
"""Farthest centre of mass of a load from the origin of its link, m."""


class PayloadError(ArmSafetyError, ValueError):
    """A load that an arm cannot carry.

    Attributes:
        kind: what of it is wrong.
    """

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(f"{kind} {detail}")
        self.kind = kind


class Payload:
    """Load on a link of an arm, which the masses of its model include.

    Args:
        model: of the arm; its `inertias` change with the load.

    Attributes:
        link: that carries the load; empty for none.
        inertia: of the load, in the axes of the link.
    """

    def __init__(self, model: pin.Model) -> None:
        self._model = model
        self._bare = _copies(model.inertias)
        self.link, self.inertia = "", pin.Inertia.Zero()

    def __str__(self) -> str:
        return f"{self.inertia.mass:.2f} kg at {self.link}" if self.link else "none"

    def carry(self, link: str, mass: float, centre: ArrayLike, moments: ArrayLike) -> bool:
        """Carry a load in place of the one before.

        Args:
            link: that it is fixed to.
            mass: kg; 0 for no load.
            centre: of mass, in the axes of the link, shape (3,), m.
            moments: of inertia about the centre in these axes, shape (3, 3), kg m^2; zeros for a
                point mass.

        Returns:
            Whether it is another load than before.

        Raises:
            PayloadError: there is no such link or body; the load is the one before.
        """
        lever, tensor = np.asarray(centre, dtype=float), np.asarray(moments, dtype=float)
        before = self.link, self.inertia
        if mass == 0.0:
            self.link, self.inertia = "", pin.Inertia.Zero()
        else:
            self._check_body(mass, lever, tensor)
            self._frame(link)
            self.link, self.inertia = link, pin.Inertia(mass, lever, tensor)
        if (self.link, self.inertia) == before:
            return False
        self._apply()
        return True

    def rebase(self, inertias: Iterable[pin.Inertia]) -> None:
        """Carry the load on other masses of the model's links, those of its joints in order."""
        self._bare = _copies(inertias)
        self._apply()

    def beyond(self, frame: str) -> pin.Inertia:
        """Return what of the load hangs on a frame without a joint between, in its axes."""
        frames, root = self._model.frames, frame_id(self._model, frame)
        index = on = self._frame(self.link) if self.link else 0
        while index > root:  # parents come first
            index = frames[index].parentFrame
        if index != root or frames[root].parentJoint != frames[on].parentJoint:
            return pin.Inertia.Zero()
        return frames[root].placement.actInv(frames[on].placement).act(self.inertia)

    def _apply(self) -> None:
        inertias = self._model.inertias
        for joint, bare in enumerate(self._bare):
            inertias[joint] = bare
        if self.link:
            frame = self._model.frames[self._frame(self.link)]
            inertias[frame.parentJoint] += frame.placement.act(self.inertia)

    def _check_body(self, mass: float, lever: Array, tensor: Array) -> None:
        if not all(np.isfinite(each).all() for each in (mass, lever, tensor)):
            raise PayloadError("numbers", "are not all finite")
        own = sum(each.mass for each in self._bare[1:])
        if not 0.0 < mass <= own:
            allowed = f"0 to {own:.3g}, the mass that the arm itself moves"
            raise PayloadError("mass", f"is {mass:g} kg; allowed: {allowed}")
        if (far := np.linalg.norm(lever)) > FARTHEST:
            allowed = f"up to {FARTHEST:g} m"
            raise PayloadError("centre of mass", f"is {far:g} m from the link; allowed: {allowed}")
        moments = np.asarray(np.linalg.eigvalsh(tensor), dtype=np.float64)
        slack = moments_slack(moments)
        impossible = moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack
        if impossible or moments[2] > mass * FARTHEST**2 + slack:
            raise PayloadError(
                "moments of inertia", f"are of no body of this mass: {shown_moments(moments)}"
            )

    def _frame(self, link: str) -> int:
        """Return the index of the frame of a link that moves."""
        frames = self._model.frames
        moving = [f.name for f in frames if f.type == pin.FrameType.BODY and f.parentJoint > 0]
        if link not in moving:
            hint = did_you_mean(link, moving) or f": {', '.join(moving)}"
            raise PayloadError("frame_id", f"is {link!r}; allowed: a link that moves{hint}")
        return frame_id(self._model, link)


def _copies(inertias: Iterable[pin.Inertia]) -> list[pin.Inertia]:
    return [each.copy() for each in inertias]
