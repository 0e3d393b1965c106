# SPDX-License-Identifier: Apache-2.0
"""An integral action as [Benallegue2021] prints it, on a given motion, by NumPy alone, for tests.

Rates are differences along the motion.
"""

import numpy as np
import pinocchio as pin

STEP = 1e-3  # s
LAMBDA, MU, SLOW, FAST = 7.0, 0.3, 0.4, 60.0


class PrintedLaw:
    """What (13), (16), (21) and (26) say of a motion; (10) and (11) are `limited`.

    Args:
        model: of the arm.
        middle: of the motion, shape (n,), rad.
        rows: of the task.
        swing: of the joints, rad.
        pace: of the motion, rad/s.
        small: of differences, s.
    """

    def __init__(self, model, middle, rows, swing, pace, small) -> None:
        self.model, self.middle, self.n = model, middle, model.nv
        self.swing, self.pace, self.small = swing, pace, small
        self.s = self.a = self.slow = self.fast = np.zeros(self.n)
        self.integral = np.zeros(rows)

    def q(self, t):
        return self.middle + self.swing * np.sin(self.pace * t + np.arange(self.n))

    def v(self, t):
        return self.pace * self.swing * np.cos(self.pace * t + np.arange(self.n))

    def a_ref(self, t):
        return 4.0 * np.cos(5.0 * t + 2.0 * np.arange(self.n))

    def M(self, t):
        return pin.crba(self.model, self.model.createData(), self.q(t))

    def J(self, t):
        """The task's Jacobian."""
        raise NotImplementedError

    def limited(self, u):
        return u

    def inverse(self, t):
        """J^+, dynamically consistent."""
        J = self.J(t)
        M_inv_JT = np.linalg.solve(self.M(t), J.T)
        return M_inv_JT @ np.linalg.inv(J @ M_inv_JT)

    def rate(self, f, t):
        return (f(t + self.small) - f(t - self.small)) / (2.0 * self.small)

    def expected(self, t):
        """Return the torque of the step that ends at t."""
        dt = STEP
        data = self.model.createData()
        C = pin.computeCoriolisMatrix(self.model, data, self.q(t), self.v(t))
        M, J, J_plus = self.M(t), self.J(t), self.inverse(t)
        K = LAMBDA * np.diag(np.diag(M))
        s_last, a_last = self.s, self.a
        self.s = s_last + self.a_ref(t - dt) * dt - (self.v(t) - self.v(t - dt))
        middle = 0.5 * (s_last + self.s)
        self.integral = self.integral + dt * self.rate(self.J, t - 0.5 * dt) @ middle
        self.a = self.s - J_plus @ self.integral  # (16)
        self.slow = np.exp(-SLOW * dt) * self.slow + self.a - a_last  # (13)
        self.fast = np.exp(-FAST * dt) * self.fast + self.a - a_last
        P = J_plus @ J
        u_K = (1.0 - MU) * P.T @ K @ P @ self.slow + MU * K @ self.fast  # (26)
        inner = J_plus @ self.rate(self.J, t) @ self.s + self.rate(self.inverse, t) @ self.integral
        return C @ self.a - M @ inner + self.limited(u_K)  # (21)
