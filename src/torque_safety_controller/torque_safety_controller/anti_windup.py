"""Anti-windup: limits on a torque that leave it a damping one, [Benallegue2021] III-B.

The integral torque u = K s is to stay within limits u_max. Three ways, all of which leave alone
what is within its limits:

- `clip_to_limits` cuts each component by itself, for comparison;
- `scale_to_limits`, eq. (10), scales the whole vector by lambda_w;
- `project_to_limits`, eq. (11), takes the nearest vector within the limits that dissipates, in
  s'x, no less than (10) does.

`docs/integral_action.md` says when the last two differ from the first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.integral_feedback import anti_windup_kernels as kernels

Array = NDArray[np.float64]


def scale_factor(u: ArrayLike, u_max: ArrayLike) -> float:
    """Return lambda_w = min(1, min_i u_max_i / |u_i|): eq. (10), [Benallegue2021].

    Rounded down, so that no lambda_w |u_i| is above u_max_i. Where u_i is 0 it is not limited,
    even by u_max_i = 0.

    Args:
        u: shape (n,), N m.
        u_max: limits, shape (n,), N m, >= 0; inf for none.

    Raises:
        ValueError: wrong shapes, u not finite, or limits negative or NaN.
    """
    u, u_max = _vectors(u=u, u_max=u_max)
    return kernels.scale_factor(u, u_max)


def scale_to_limits(u: ArrayLike, u_max: ArrayLike) -> Array:
    """Return ``lambda_w u``, shape (n,), N m: eq. (10), [Benallegue2021]; see `scale_factor`."""
    u, u_max = _vectors(u=u, u_max=u_max)
    x = kernels.scale_factor(u, u_max) * u
    kernels.clip(x, u_max, x)  # off by rounding at most
    return x


def clip_to_limits(u: ArrayLike, u_max: ArrayLike) -> Array:
    """Return `u` with each component cut to its limit, shape (n,), N m; see `scale_factor`."""
    u, u_max = _vectors(u=u, u_max=u_max)
    x = np.empty_like(u)
    kernels.clip(u, u_max, x)
    return x


def project_to_limits(u: ArrayLike, s: ArrayLike, u_max: ArrayLike) -> Array:
    """Solve the QP of eq. (11), [Benallegue2021], exactly.

        minimise  |x - u|^2   subject to   -u_max <= x <= u_max,   s'x >= lambda_w s'u.

    It always has a solution: lambda_w u. Both constraints hold for the numbers returned, not
    only up to rounding.

    Args:
        u: shape (n,), N m; K s in the paper, but any vector will do.
        s: shape (n,), rad/s; only its direction matters.
        u_max: limits, shape (n,), N m, >= 0; inf for none.

    Returns:
        x, shape (n,), N m.

    Raises:
        ValueError: wrong shapes, u or s not finite, or limits negative or NaN.
    """
    u, s, u_max = _vectors(u=u, s=s, u_max=u_max)
    x = np.empty_like(u)
    kernels.project(u, s, u_max, x)
    return x


def _vectors(**arrays: ArrayLike) -> list[Array]:
    """Return the arguments as arrays of one length; `u_max` must be among them."""
    vectors = [np.ascontiguousarray(x, dtype=np.float64) for x in arrays.values()]
    u_max = vectors[-1]
    for name, x in zip(arrays, vectors, strict=True):
        if x.ndim != 1 or x.shape != u_max.shape:
            shapes = ", ".join(f"{key} {y.shape}" for key, y in zip(arrays, vectors, strict=True))
            raise ValueError(f"must all have shape (n,): {shapes}")
        if x is u_max:
            if not kernels.all_limits(x):
                raise ValueError(f"{name} must be numbers >= 0, is {x}")
        elif not kernels.all_finite(x):
            raise ValueError(f"{name} must be finite, is {x}")
    return vectors
