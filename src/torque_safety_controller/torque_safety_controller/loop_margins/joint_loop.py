# SPDX-License-Identifier: Apache-2.0
"""The loop of one joint in discrete time: motor, delay, state estimation, gains.

    command -> delay -> motor lag -> joint -> estimation, prediction -> gains -> command

All of it is linear, and sampled once a control period. Each quantity is a row vector, what it is
made of: of the state of the loop and of the command that enters at the motor. One step of the
loop, written with such rows, gives its matrices. `docs/gains.md` derives it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors

Array = NDArray[np.float64]

_FREQUENCIES = 200
_SLOWEST = 1e-4  # of the Nyquist frequency
_ROUNDING = 1e-6  # of a pole: kp = 0 leaves one at 1


class Link(NamedTuple):
    """What lies between a command and the joint.

    Attributes:
        dt: control period, s.
        delay: whole periods from the state that a command answers to its effect.
        bandwidth: of the motor's torque, first order, rad/s.
    """

    dt: float
    delay: int = 0
    bandwidth: float = math.inf


class ObserverGains(NamedTuple):
    """Shares of an error of the position that correct position and velocity, 1 and 1/s."""

    position: Array
    velocity: Array


class Sensing(NamedTuple):
    """How the controller knows the state.

    Attributes:
        observer: gains of the observer that estimates the velocity; None for one that is measured,
            or differenced.
        filter_rate: low-pass of a velocity by differences of the position, rad/s, perhaps
            infinite; None for one that is measured, or observed.
        predicted: periods by which the state is predicted, and the motor lag with it; None for
            no prediction.
    """

    observer: ObserverGains | None = None
    filter_rate: float | None = None
    predicted: int | None = None


class Feedback(NamedTuple):
    """Gains of a joint, on its acceleration.

    Attributes:
        kp: on the position, 1/s^2.
        kd: on the velocity, 1/s.
        integral: lambda of the integral action, times what the inertia makes of it, 1/s.
        leak: its rates theta_s and theta_f, 1/s, and the share mu of the fast one.
        disturbance_time: time constant of the disturbance observer whose estimate is taken off,
            s; None for none.
    """

    kp: float
    kd: float
    integral: float = 0.0
    leak: tuple[float, float, float] = (0.1, 100.0, 0.5)
    disturbance_time: float | None = None


class Motion(NamedTuple):
    """One period of position, velocity and acceleration: x' = A x + b command."""

    A: Array
    b: Array


class OpenLoop(NamedTuple):
    """The loop, opened at the motor: x' = A x + b entering, returning = c x.

    Attributes:
        A, b, c: of shapes (n, n), (n,) and (n,).
        dt: control period, s.
    """

    A: Array
    b: Array
    c: Array
    dt: float

    def spectral_radius(self) -> float:
        """Return the largest magnitude of the closed loop's poles."""
        closed = self.A + np.outer(self.b, self.c)
        return float(np.abs(np.linalg.eigvals(closed)).max())

    def modulus_margin(self) -> float:
        """Return the least distance of the Nyquist curve from -1; 0 for an unstable loop."""
        if self.spectral_radius() > 1.0 + _ROUNDING:
            return 0.0
        angles = math.pi * np.geomspace(_SLOWEST, 1.0, _FREQUENCIES)
        z = np.exp(1j * angles)[:, None, None] * np.eye(len(self.b))
        states = np.linalg.solve(z - self.A, np.broadcast_to(self.b[:, None], (*z.shape[:2], 1)))
        return float(np.abs(1.0 - self.c @ states[..., 0].T).min())


def motion(link: Link) -> Motion:
    """Return a period of a joint under a held command, with the motor's lag, exactly."""
    dt, lag = link.dt, 1.0 / link.bandwidth
    left = math.exp(-dt / lag) if lag > 0.0 else 0.0
    moved = lag * (1.0 - left)
    way = lag * (dt - moved)
    A = np.array([[1.0, dt, way], [0.0, 1.0, moved], [0.0, 0.0, left]])
    return Motion(A, np.array([0.5 * dt**2 - way, dt - moved, 1.0 - left]))


def filter_share(time_constant: float, dt: float) -> float:
    """Return the share of what is new that a low-pass takes in a period."""
    return -math.expm1(-dt / time_constant) if time_constant > 0.0 else 1.0


def open_loop(link: Link, sensing: Sensing, gains: Feedback) -> OpenLoop:
    """Return the loop of a joint, opened at the motor.

    Args:
        link: true delay and lag; the prediction knows the lag, and `sensing.predicted` periods.
        sensing: how the state is known.
        gains: of the feedback.
    """
    assumed = 0 if sensing.predicted is None else sensing.predicted
    names = ["q", "v", "a"] + [f"late{i}" for i in range(link.delay)]
    names += ["q_seen", "v_seen", "a_seen"] + [f"sent{i}" for i in range(assumed)]
    names += ["q_before", "v_before", "a_ref_before", "fast", "slow", "disturbance"]
    rows = np.eye(len(names) + 1)
    x = dict(zip(names, rows, strict=False))
    entering = rows[-1]
    new: dict[str, Array] = {}

    # The state as it is known for its own instant: q_seen, v_seen come predicted from the last.
    q, v, dt = x["q"], x["v"], link.dt
    seen = [q, v, x["a_seen"]]
    if sensing.observer is not None:
        error = q - x["q_seen"]
        seen[0] = x["q_seen"] + sensing.observer.position * error
        seen[1] = x["v_seen"] + sensing.observer.velocity * error
    elif sensing.filter_rate is not None:
        share = filter_share(1.0 / sensing.filter_rate, dt)
        seen[1] = x["v_seen"] + share * ((q - x["q_before"]) / dt - x["v_seen"])
    new["q_before"] = q
    # As it is when the next command acts; with the lag it is where it would coast to.
    model = motion(link if sensing.predicted is not None else link._replace(bandwidth=math.inf))
    ahead = list(seen)
    for i in reversed(range(assumed)):
        ahead = _moved(model, ahead, x[f"sent{i}"])
    if sensing.predicted is not None and link.bandwidth < math.inf:
        ahead[:2] = [ahead[0] + ahead[1] / link.bandwidth, ahead[1] + ahead[2] / link.bandwidth]
    known_q, known_v = ahead[:2]

    # Integral action and disturbance observer, then the command.
    theta_slow, theta_fast, mu = gains.leak
    increment = x["a_ref_before"] * dt - (known_v - x["v_before"])
    for name, theta in (("fast", theta_fast), ("slow", theta_slow)):
        decay, share = leak_factors(theta, dt, False)
        new[name] = decay * x[name] + share * increment
    a_ref = -gains.kp * known_q - gains.kd * known_v
    new["disturbance"] = x["disturbance"]
    if gains.disturbance_time is not None:
        share = filter_share(gains.disturbance_time, dt)
        error = -increment / dt - x["disturbance"]
        new["disturbance"] = x["disturbance"] + share * error
        a_ref = a_ref - new["disturbance"]
    command = a_ref + gains.integral * (mu * new["fast"] + (1.0 - mu) * new["slow"])
    new["v_before"], new["a_ref_before"] = known_v, a_ref

    # What the controller believes to act now, and what does.
    queue = [command, *(x[f"sent{i}"] for i in range(assumed))]
    new |= {f"sent{i}": row for i, row in enumerate(queue[:-1])}
    believed = dict(
        zip(("q_seen", "v_seen", "a_seen"), _moved(model, seen, queue[-1]), strict=True)
    )
    if sensing.observer is None:
        believed["v_seen"] = seen[1]
    new |= believed
    queue = [entering, *(x[f"late{i}"] for i in range(link.delay))]
    new |= {f"late{i}": row for i, row in enumerate(queue[:-1])}
    new |= dict(zip("qva", _moved(motion(link), [x["q"], x["v"], x["a"]], queue[-1]), strict=True))
    step = np.array([new[name] for name in names])
    return OpenLoop(step[:, :-1], step[:, -1], command[:-1], dt)


def _moved(motion: Motion, state: list[Array], command: Array) -> list[Array]:
    """Return position, velocity and acceleration a period later."""
    after = motion.A @ np.array(state) + np.outer(motion.b, command)
    return list(after)
