"""Closest points of segments and boxes, in closed form and compiled."""

from __future__ import annotations

from math import sqrt

import numpy as np

from torque_safety_controller.collision.vectors3 import along, column, compiled, dot, sub

_SHORT = 1e-12  # m^2; a segment with less is a point
_DEEP = 60  # bisections: to rounding


@compiled
def clamp(x, low, high):
    """Return the number of [low, high] that is nearest to x."""
    return low if x < low else (high if x > high else x)


@compiled
def on_segment(point, a, u):
    """Return t in [0, 1] so that a + t u is nearest to a point."""
    square = dot(u, u)
    return clamp(dot(sub(point, a), u) / square, 0.0, 1.0) if square > _SHORT else 0.0


@compiled
def between_segments(a, u, b, w):
    """Return s and t in [0, 1] so that a + s u and b + t w are nearest to each other.

    [Ericson2005], 5.1.9. For parallel segments one of many.
    """
    r = sub(a, b)
    uu, ww, wr = dot(u, u), dot(w, w), dot(w, r)
    if uu <= _SHORT:
        return 0.0, on_segment(a, b, w)
    if ww <= _SHORT:
        return on_segment(b, a, u), 0.0
    ur, uw = dot(u, r), dot(u, w)
    square = uu * ww - uw * uw
    s = clamp((uw * wr - ur * ww) / square, 0.0, 1.0) if square > 1e-12 * uu * ww else 0.0
    t = (uw * s + wr) / ww
    if t < 0.0:
        return clamp(-ur / uu, 0.0, 1.0), 0.0
    if t > 1.0:
        return clamp((uw - ur) / uu, 0.0, 1.0), 1.0
    return s, t


@compiled
def in_axes(point, R: np.ndarray, centre):
    """Return a point in the axes R, shape (3, 3), about `centre`."""
    r = sub(point, centre)
    return dot(r, column(R, 0)), dot(r, column(R, 1)), dot(r, column(R, 2))


@compiled
def _slope(s, a, u, half):
    """Return half the derivative of the squared distance of a + s u from a box at zero."""
    slope = 0.0
    for k in range(3):
        x = a[k] + s * u[k]
        slope += u[k] * (x - clamp(x, -half[k], half[k]))
    return slope


@compiled
def _depth(x, half):
    """Return the signed distance of a point from the nearest face; negative inside a box."""
    return max(abs(x[0]) - half[0], abs(x[1]) - half[1], abs(x[2]) - half[2])


@compiled
def segment_to_box(a, u, half):
    """Return s in [0, 1] so that a + s u is nearest to a box, or deepest in it.

    The squared distance is convex and piecewise quadratic in s: its slope is followed from one
    break to the next. All in the axes of the box, whose corners are at +- `half`.
    """
    if dot(u, u) <= _SHORT:
        return 0.0
    low, high = 0.0, 1.0
    slope_low, slope_high = _slope(0.0, a, u, half), _slope(1.0, a, u, half)
    if slope_low > 0.0:
        s = 0.0
    elif slope_high < 0.0:
        s = 1.0
    else:
        for k in range(3):
            for side in (-half[k], half[k]):
                if abs(u[k]) > 1e-300:
                    x = (side - a[k]) / u[k]
                    if low < x < high:
                        slope = _slope(x, a, u, half)
                        if slope < 0.0:
                            low, slope_low = x, slope
                        else:
                            high, slope_high = x, slope
        rise = slope_high - slope_low
        s = low - (high - low) * slope_low / rise if rise > 0.0 else 0.5 * (low + high)
    if _depth(along(a, s, u), half) > 0.0:
        return s
    # The segment goes through the box: the depth is convex in s, too.
    low, high = 0.0, 1.0
    for _ in range(_DEEP):
        third = (high - low) / 3.0
        if _depth(along(a, low + third, u), half) < _depth(along(a, high - third, u), half):
            high -= third
        else:
            low += third
    return 0.5 * (low + high)


@compiled
def point_to_box(x, half):
    """Return the signed distance of a point from a box, the normal and which axes are free.

    All in the axes of the box. Free axes are those of the face or edge that the closest point
    lies in. Inside, the nearest face is meant, and the distance is negative.
    """
    rx = x[0] - clamp(x[0], -half[0], half[0])
    ry = x[1] - clamp(x[1], -half[1], half[1])
    rz = x[2] - clamp(x[2], -half[2], half[2])
    d = sqrt(rx * rx + ry * ry + rz * rz)
    if d > 0.0:
        return d, (rx / d, ry / d, rz / d), (rx == 0.0, ry == 0.0, rz == 0.0)
    ex, ey, ez = abs(x[0]) - half[0], abs(x[1]) - half[1], abs(x[2]) - half[2]
    if ex >= ey and ex >= ez:
        return ex, (1.0 if x[0] >= 0.0 else -1.0, 0.0, 0.0), (False, True, True)
    if ey >= ez:
        return ey, (0.0, 1.0 if x[1] >= 0.0 else -1.0, 0.0), (True, False, True)
    return ez, (0.0, 0.0, 1.0 if x[2] >= 0.0 else -1.0), (True, True, False)
