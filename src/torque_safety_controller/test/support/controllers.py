# SPDX-License-Identifier: Apache-2.0
"""Controllers of the configured arms, made by hand, and inputs of all kinds, for tests."""

import math

import numpy as np
import pinocchio as pin
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from torque_safety_controller.controller import Controller
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.parts.friction import Friction
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.integral import FadingTorque, Integral, make_integral
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.parts.slow_down import SlowDown
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.state import State

GAINS = Gains(
    pose_kp=10.0,
    pose_kd=6.0,
    pose_weight=1.0,
    posture_kp=8.0,
    posture_kd=5.0,
    posture_weight=1e-3,
    hold_kd=20.0,
)
EXACT = 1e-9  # N m; rounding
SOLVED = 1e-4  # rad/s^2; how exactly the QP is solved
KHZ = 1e-3  # s
WIDE = 1e3  # rad/s^2; bounds that no one feels


def posture_only(kp: float, kd: float) -> Gains:
    """Gains of a controller to which poses mean nothing."""
    return Gains(
        pose_kp=kp,
        pose_kd=kd,
        pose_weight=0.0,
        posture_kp=kp,
        posture_kd=kd,
        posture_weight=1.0,
        hold_kd=20.0,
    )


def make(
    arm,
    *further,
    robot=None,
    tau_max=None,
    gains=GAINS,
    integral=None,
    friction=None,
    **arguments,
) -> Controller:
    """A controller with goals, bounds, and what is asked for; `further` follow the bounds."""
    robot = arm.robot() if robot is None else robot
    parts = [Goals(robot.n, gains, len(robot.others))]
    if integral is not None:
        parts.append(Integral(integral, robot))
    if friction is not None:
        parts.append(Friction(friction))
    if gains.disturbance_time:
        parts.append(Disturbance(robot.n, gains.disturbance_time))
    return Controller(
        robot,
        [*parts, JointBounds(), *further, SlowDown(arm.q_min, arm.q_max, robot.dt)],
        arm.tau_max if tau_max is None else tau_max,
        hold_kd=gains.hold_kd,
        **arguments,
    )


def strong(arm, **arguments) -> Controller:
    """A controller that torque limits do not keep from anything."""
    return make(arm, tau_max=np.full(arm.n, 1e4), **arguments)


def wide(arm) -> AccelerationRange:
    return AccelerationRange(np.full(arm.n, -WIDE), np.full(arm.n, WIDE))


def pose_at(arm, q) -> pin.SE3:
    robot = arm.robot(0.0)
    robot.update(State(q, np.zeros(arm.n)), np.zeros(arm.n))
    return robot.pose.copy()


def gravity(arm, q) -> np.ndarray:
    return pin.computeGeneralizedGravity(arm.model, arm.model.createData(), q)


def assert_may_be_sent(step, arm) -> None:
    assert step.tau.shape == (arm.n,)
    assert np.isfinite(step.tau).all()
    assert (np.abs(step.tau) <= arm.tau_max).all()


def integral(arm, mode, **changed) -> FadingTorque:
    settings = IntegralSettings(**{"budget": 0.2 * arm.tau_max, "gain": 30.0} | changed)
    return make_integral(mode, settings, 2.0 * arm.tau_max)


def with_integral(arm, mode="joints", gains=GAINS, rate=None, **changed) -> Controller:
    """A controller at 1 kHz."""
    action = integral(arm, mode, **changed)
    return make(arm, robot=arm.robot(KHZ), gains=gains, integral=action, torque_rate_max=rate)


NUMBERS = st.one_of(
    st.floats(-4.0, 4.0),
    st.floats(-1e3, 1e3),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324]),
)
VECTORS = arrays(float, 7, elements=NUMBERS)
