# SPDX-License-Identifier: Apache-2.0
"""Friction compensation in the controller and its node: limits, handover, parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from arms import load_arm
from controller_chain import NODE, ControllerChain
from controllers import make, posture_only

from torque_safety_controller.friction.settings import FrictionModel, FrictionSettings
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parts.friction import Friction
from torque_safety_controller.parts.integral import make_integral
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

ARM = load_arm("panda")
N = ARM.n
DT = 1e-3
COULOMB = 0.1 * ARM.tau_max
MODEL = FrictionModel(COULOMB, 1.3 * COULOMB, 0.2 * COULOMB, np.full(N, 0.02))
ON = FrictionSettings(MODEL, 0.2 * ARM.tau_max, 1.0)
WIDE = AccelerationRange(np.full(N, -50.0), np.full(N, 50.0))
V = 0.3 * np.sign(0.5 - np.arange(N) % 2)
MOVING = State(ARM.q_start, V)
WANTED = -np.sign(V)
"""In a state that does not change each joint is wanted to stop, and does not."""
FIRM = slice(0, 5)
"""Joints with inertia enough to call for all of the friction."""


def controller(mode="none", friction=ON):
    settings = IntegralSettings(0.05 * ARM.tau_max, gain=30.0)
    made = make(
        ARM,
        robot=ARM.robot(DT),
        gains=posture_only(100.0, 20.0),
        integral=make_integral(mode, settings, 2.0 * ARM.tau_max),
        friction=friction,
    )
    made.reset(ARM.q_start)
    made.goals.set_posture(ARM.q_start)
    return made


def test_the_qp_keeps_the_sum_within_the_torque_limits():
    """Not by cutting it: the torque sent is the one for the acceleration returned."""
    rng = np.random.default_rng(0)
    strong = FrictionModel(0.4 * ARM.tau_max, 0.4 * ARM.tau_max, 0.0 * COULOMB, np.ones(N))
    made = controller(friction=FrictionSettings(strong, 0.5 * ARM.tau_max, 1.0))
    at_limit = 0
    for _ in range(400):
        q = ARM.q_start + 0.3 * rng.standard_normal(N)
        step = made.step(State(q, 0.2 * rng.standard_normal(N)), WIDE)
        assert not step.failure
        assert (np.abs(step.tau) <= ARM.tau_max).all()
        wanted = made.robot.torque(step.a) + made.find(Friction).last
        np.testing.assert_allclose(step.tau, wanted, atol=0.02 * ARM.tau_max.max())
        at_limit += (np.abs(step.tau) > 0.98 * ARM.tau_max).any()
    assert at_limit > 20


def test_the_handover_goes_on_from_the_drives_torque_and_friction_fades_in():
    made = controller(mode="joints")
    for _ in range(500):
        made.step(MOVING, WIDE)
    rest = np.zeros(N)
    made.robot.update(State(ARM.q_start, rest), rest)
    tau = made.robot.h + 0.04 * ARM.tau_max
    made.resume(MOVING, WIDE, tau)
    first = made.step(MOVING, WIDE)
    friction = made.find(Friction).last
    assert (np.abs(friction) <= 1.01 * DT / 0.2 * MODEL.level(V)).all()
    assert np.abs((first.tau - tau) / ARM.tau_max).max() < 0.01


GIVEN = {
    "friction_compensation": 0.5,
    "friction_model_coulomb": COULOMB.tolist(),
    "friction_model_static": (1.3 * COULOMB).tolist(),
}


def test_it_is_switched_while_the_node_runs(ros):
    """Of a robot that stands at one place and has a speed: the estimator would refuse it."""
    values = read_config("panda", NODE) | {
        **GIVEN,
        "friction_compensation": 0.0,
        "use_estimated_states": True,
        "bounds_timeout": 20.0,
        "state_timeout": 40.0,
    }
    chain, stamp = ControllerChain(ros, values), 0

    def answer():
        nonlocal stamp
        stamp += round(1e3 * ARM.dt)

        def send():
            chain.send_limits(stamp, *WIDE)
            chain.send_state(stamp, *MOVING)

        return np.array(chain.await_command(stamp, send).effort)

    before = [answer() for _ in range(2)][-1]
    ros.accepts(NODE, friction_compensation=1.0)
    after = [answer() for _ in range(60)]
    # Nothing is viscous, and V too fast for stiction.
    full = WANTED * COULOMB
    assert (np.abs(after[0] - before) < 1.1 * ARM.dt / 0.2 * COULOMB).all()
    share = 1.0 - math.exp(-60 * ARM.dt / 0.2)
    np.testing.assert_allclose((after[-1] - before)[FIRM], share * full[FIRM], atol=1e-3)
    assert "at least friction_model_coulomb" in ros.refuses(NODE, friction_model_static=[0.01] * N)
    ros.wait_until(
        lambda: (
            float((chain.reported("friction_torque_nm") or "0").split()[0])
            == pytest.approx(share * full[0], abs=1e-3)
        ),
        "the diagnostics",
    )
