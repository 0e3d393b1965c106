# SPDX-License-Identifier: Apache-2.0
"""Terms of the QP's cost: weighted least squares in the accelerations or the contact forces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class TaskTerm(NamedTuple):
    """The term ``weight * |A a - b|^2`` of the cost: eq. (5) and (9) of [Benallegue2021]."""

    A: Array | None
    """Shape (m, n); None for the identity, which spares the product."""
    b: Array
    """Shape (m,)."""
    weight: float

    def mixed(self, a: Array, share: float) -> TaskTerm:
        """Return the term that wants `share` of its own and the rest of an acceleration.

        Args:
            a: shape (n,), rad/s^2.
            share: from 0 to 1.
        """
        other = a if self.A is None else self.A @ a
        return self._replace(b=share * self.b + (1.0 - share) * other)


class WrenchTerm(NamedTuple):
    """The term ``weight * |W rho - F_des|^2`` of the cost: [Benallegue2021], III-E (a)."""

    W: Array
    """Shape (m, r): what rho >= 0 means as a wrench, or as some components of it."""
    F_des: Array
    """Shape (m,), N and N m: what the environment should exert on the link."""
    weight: float
    first: int
    """Where the r coefficients begin among those of all contacts."""
