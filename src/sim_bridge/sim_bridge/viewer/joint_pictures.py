# SPDX-License-Identifier: Apache-2.0
"""Pictures of joints: the plane of position and velocity, torque and acceleration, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import viable_velocity_range

Array = NDArray[np.float64]

WIDTH, HEIGHT = 172, 136
"""Of the picture of one joint, in units of SVG."""
COLUMNS = 2

_PLANE = 8.0, 18.0, 156.0, 76.0  # left, top, width, height
_WORDS_BELOW = 103.0  # the plane: their base line
_BARS = 108.0, 122.0  # top of the bars of torque and acceleration
_BAR_HEIGHT = 8.0
_WINDOW = math.pi
"""Half the width of the plane of a joint without position limits, rad."""
_NEAR = 1e-3
"""Distance from a position limit that counts as at it, rad."""
_CALM, _WARNED, _AT_LIMIT = np.array(
    [[96.0, 165.0, 115.0], [240.0, 170.0, 50.0], [205.0, 45.0, 45.0]]
)


LEGEND = (
    '<div style="font: 11px sans-serif; color: #333; padding: 0 1em">'
    '<b style="color: #60a573">green</b> is far from the limits of a joint, '
    '<b style="color: #cd2d2d">red</b> at one, also on the arm. '
    "<b>●</b> is the state of the joint. In the "
    '<b style="background: #cfe3f5">blue</b> of its plane it can still brake before its limits. '
    "<b>τ</b> is its torque, <b>a</b> its acceleration: "
    '<b style="background: #cfe3f5">blue</b> is what is allowed now.</div>'
)
"""What the pictures and colours mean, as HTML."""


class JointValues(NamedTuple):
    """What is shown of the joints now; arrays of shape (n,), NaN where nothing is known."""

    q: Array
    """rad."""
    v: Array
    """rad/s."""
    tau: Array
    """Torque of the motors, N m."""
    a: Array
    """Mean acceleration since the last picture, rad/s^2."""
    a_lower: Array
    """Acceleration limits of the present state, rad/s^2."""
    a_upper: Array


def usage(values: JointValues, limits: JointLimits, tau_max: Array) -> Array:
    """Return how far each joint is on its way to its nearest limit, 0 to 1, more beyond.

    Of the state it is the share that its speed has of the highest one that can still be braked
    there: the border of the viability kernel, or the speed limit; of the torque its share.

    Returns:
        Shape (n,).
    """
    lowest, highest = viable_velocity_range(values.q, limits)
    inside = np.minimum(values.q - limits.q_min, limits.q_max - values.q)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = values.v / np.where(values.v < 0.0, lowest, highest)
        torque = np.abs(values.tau) / tau_max
    at_limit = inside - limits.rest_distance < _NEAR
    speed = np.where(at_limit, 1.0, np.nan_to_num(speed, nan=0.0, posinf=np.inf))
    return np.asarray(np.maximum(speed, np.nan_to_num(torque)))


def colour(share: float) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a share of a limit: green, amber, red."""
    share = min(max(share, 0.0), 1.0)
    if share < 0.8:
        mixed = _CALM + max(share - 0.4, 0.0) / 0.4 * (_WARNED - _CALM)
    else:
        mixed = _WARNED + (share - 0.8) / 0.2 * (_AT_LIMIT - _WARNED)
    red, green, blue = (round(float(part)) for part in mixed)
    return red, green, blue


class JointPictures:
    """Draws the joints of an arm.

    Args:
        joints: their names.
        limits: of the n joints.
        tau_max: torque limits, shape (n,), N m.
        units: of the joints' positions; rad if not given.
    """

    def __init__(
        self,
        joints: Sequence[str],
        limits: JointLimits,
        tau_max: Array,
        units: Sequence[str] = (),
    ) -> None:
        self._joints, self._limits, self._tau_max = tuple(joints), limits, tau_max
        self._units = units or ("rad",) * len(self._joints)
        self._borders = _borders(limits)

    def draw(self, values: JointValues) -> str:
        """Return the picture of all joints as one SVG element."""
        shares = usage(values, self._limits, self._tau_max)
        rows = -(-len(self._joints) // COLUMNS)
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" class="joints" width="97%" '
            f'viewBox="0 0 {COLUMNS * WIDTH} {rows * HEIGHT}" font-family="sans-serif">'
        ]
        for k in range(len(self._joints)):
            x, y = WIDTH * (k % COLUMNS), HEIGHT * (k // COLUMNS)
            parts.append(f'<g transform="translate({x} {y})">')
            parts += self._joint(k, values, float(shares[k]))
            parts.append("</g>")
        parts.append("</svg>")
        return "".join(parts)

    def _joint(self, k: int, values: JointValues, share: float) -> list[str]:
        limits = self._limits
        q, v = float(values.q[k]), float(values.v[k])
        fill = "#{:02x}{:02x}{:02x}".format(*colour(share))
        left, top, width, height = _PLANE
        low, high = float(limits.q_min[k]), float(limits.q_max[k])
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high = q - _WINDOW, q + _WINDOW
        v_max = float(limits.v_max[k])

        def place(at: float, speed: float) -> tuple[float, float]:
            across = left + width * (0.04 + 0.92 * (at - low) / (high - low))
            down = top + height * (0.5 - 0.46 * speed / v_max)
            return across, down

        def points(states: Sequence[tuple[float, float]] | Array) -> str:
            return " ".join("{:.1f},{:.1f}".format(*place(*state)) for state in states)

        box = [(low, v_max), (high, v_max), (high, -v_max), (low, -v_max)]
        allowed, kernel = box, box
        if (borders := self._borders[k]) is not None:
            allowed, kernel = borders
        across, down = place(q, v)
        name = escape(self._joints[k])
        distance = min(q - float(limits.q_min[k]), float(limits.q_max[k]) - q)
        room = "no position limit"
        if math.isfinite(distance):
            room = f"to limit {distance:.3f} {self._units[k]}"
        small = 'font-size="7.5" fill="#555"'
        middle = left - 2.0, top + 0.5 * height
        return [
            f'<text x="{left}" y="12" font-size="9.5" fill="#333">{name}</text>',
            f'<text x="{left}" y="{_WORDS_BELOW}" {small}>position</text>',
            f'<text transform="translate({middle[0]} {middle[1]}) rotate(-90)" '
            f'{small} text-anchor="middle">speed</text>',
            f'<text x="{left + width}" y="{_WORDS_BELOW}" font-size="9" fill="{fill}" '
            f'text-anchor="end">{room}</text>',
            f'<polygon points="{points(allowed)}" fill="#f4f4f4" stroke="#888"/>',
            f'<polygon points="{points(kernel)}" fill="#cfe3f5" stroke="#3b76af" '
            'stroke-width="0.8"/>',
            f'<circle cx="{across:.1f}" cy="{down:.1f}" r="3.6" fill="{fill}" stroke="#222"/>',
            *self._bar(_BARS[0], "τ", float(self._tau_max[k]), float(values.tau[k])),
            *self._bar(
                _BARS[1],
                "a",
                max(-float(limits.a_min[k]), float(limits.a_max[k])),
                float(values.a[k]),
                (float(values.a_lower[k]), float(values.a_upper[k])),
            ),
        ]

    def _bar(
        self,
        top: float,
        name: str,
        most: float,
        value: float,
        between: tuple[float, float] | None = None,
    ) -> list[str]:
        """Return a bar from -most to most, the allowed interval in it, and a mark at `value`."""
        left, width = _PLANE[0] + 10.0, _PLANE[2] - 10.0

        def at(number: float) -> float:
            return left + width * (0.5 + 0.5 * min(max(number / most, -1.0), 1.0))

        low, high = (-most, most) if between is None else between
        parts = [
            f'<text x="{_PLANE[0]}" y="{top + 7.5}" font-size="9" fill="#555">{name}</text>',
            f'<rect x="{left}" y="{top}" width="{width}" height="{_BAR_HEIGHT}" fill="#eee"/>',
        ]
        if low <= high:
            parts.append(
                f'<rect x="{at(low):.1f}" y="{top}" width="{at(high) - at(low):.1f}" '
                f'height="{_BAR_HEIGHT}" fill="#cfe3f5"/>'
            )
        if math.isfinite(value):
            parts.append(
                f'<rect x="{at(value) - 1.0:.1f}" y="{top - 1.0}" width="2" '
                f'height="{_BAR_HEIGHT + 2.0}" fill="#222"/>'
            )
        return parts


def _borders(limits: JointLimits) -> list[Array | None]:
    """Return the borders of what is allowed and of the kernel of each joint.

    Returns:
        Of each joint shape (2, m, 2), rad and rad/s; None where it is endless.
    """
    finite = np.isfinite(limits.q_min) & np.isfinite(limits.q_max)
    low, high = np.where(finite, limits.q_min, 0.0), np.where(finite, limits.q_max, 0.0)
    # Positions are dense where the border is steep.
    spread = np.sin(np.linspace(-0.5, 0.5, 61) * np.pi)[:, None]
    q = np.clip(0.5 * (low + high) + 0.5 * (high - low) * spread, low, high)
    borders = np.stack(
        [
            np.stack([np.r_[q, q[::-1]], np.r_[fastest, slowest[::-1]]], axis=-1)
            for slowest, fastest in (limits.velocities(q), viable_velocity_range(q, limits))
        ]
    )
    return [borders[:, :, k] if finite[k] else None for k in range(finite.size)]
