# SPDX-License-Identifier: Apache-2.0
"""Friction compensation in the controller and its node: parameters, limits, handover."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
from arms import load_arm
from controller_chain import NODE, ControllerChain
from controllers import make, posture_only

from torque_safety_controller.controller import Controller
from torque_safety_controller.friction.settings import FrictionModel, FrictionSettings
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parameters.controller_parameters import FrictionConfiguration
from torque_safety_controller.parts.friction import Friction
from torque_safety_controller.parts.integral import Integral, make_integral
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import group, read
from viability_bounds_pkg.robot.configuration import RobotConfiguration
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import names_parameter, read_config

ARM = load_arm("panda")
N = ARM.n
DT = 1e-3
COULOMB = 0.1 * ARM.tau_max
MODEL = FrictionModel(COULOMB, 1.3 * COULOMB, 0.2 * COULOMB, np.full(N, 0.02))
ON = FrictionSettings(MODEL, 0.2 * ARM.tau_max, 1.0)
OFF = FrictionSettings(MODEL, 0.2 * ARM.tau_max, 0.0)
GAINS = posture_only(100.0, 20.0)
WIDE = np.full(N, 50.0)
V = 0.3 * np.sign(0.5 - np.arange(N) % 2)
# Of a state that does not change: each joint is wanted to stop, and does not.
WANTED = -np.sign(V)
FIRM = slice(0, 5)  # joints with inertia enough to call for all of the friction


def controller(mode="none", friction=ON) -> Controller:
    settings = IntegralSettings(0.05 * ARM.tau_max, gain=30.0)
    integral = make_integral(mode, settings, 2.0 * ARM.tau_max)
    made = make(ARM, robot=ARM.robot(DT), gains=GAINS, integral=integral, friction=friction)
    made.reset(ARM.q_start)
    made.goals.set_posture(ARM.q_start)
    return made


def steps(made, count, q=ARM.q_start, v=V):
    """Return the last of some steps at one state."""
    for _ in range(count):
        step = made.step(State(q, v), AccelerationRange(-WIDE, WIDE))
    return step


def test_both_are_added_and_the_integral_s_budget_is_its_own():
    made = controller(mode="joints")
    step = steps(made, 3000)
    integral, friction = made.find(Integral).action, made.find(Friction)
    both = step.tau - made.robot.torque(step.a)
    np.testing.assert_allclose(both, integral.last + friction.last, atol=1e-9)
    assert integral.saturated.any()
    budget = integral.settings.budget
    assert (np.abs(integral.last) <= budget * (1.0 + 1e-9)).all()
    assert (np.abs(both) > budget).any()


def test_without_integral_action_there_is_friction_only():
    made = controller()
    tau = steps(made, 2000).tau
    assert not made.find(Integral).action.last.any()
    without = controller(friction=OFF)
    steps(without, 2000)
    assert without.find(Friction).idle
    full = WANTED * np.minimum(MODEL.level(V), ON.budget)
    added = tau - steps(without, 1).tau
    np.testing.assert_allclose(added[FIRM], full[FIRM], rtol=1e-2)


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_the_qp_keeps_the_sum_within_the_torque_limits(share):
    """Not by cutting it: the torque sent is the one for the acceleration returned."""
    rng = np.random.default_rng(0)
    strong = FrictionModel(share * ARM.tau_max, share * ARM.tau_max, 0.0 * COULOMB, np.ones(N))
    made = controller(friction=FrictionSettings(strong, 0.5 * ARM.tau_max, 1.0))
    at_limit = 0
    for _ in range(400):
        q = ARM.q_start + 0.3 * rng.standard_normal(N)
        v = 0.2 * rng.standard_normal(N)
        step = made.step(State(q, v), AccelerationRange(-WIDE, WIDE))
        assert (np.abs(step.tau) <= ARM.tau_max).all()
        assert not step.failure
        wanted = made.robot.torque(step.a) + made.find(Friction).last
        np.testing.assert_allclose(step.tau, wanted, atol=0.02 * ARM.tau_max.max())
        at_limit += (np.abs(step.tau) > 0.98 * ARM.tau_max).any()
    assert at_limit > 20


def test_the_handover_goes_on_from_the_drives_torque_and_friction_fades_in():
    made = controller(mode="joints")
    steps(made, 2000)
    q, rest = ARM.q_start, np.zeros(N)
    made.robot.update(State(q, rest), rest)
    tau = made.robot.h + 0.04 * ARM.tau_max
    made.resume(State(q, V), AccelerationRange(-WIDE, WIDE), tau)
    np.testing.assert_array_equal(made.find(Friction).last, 0.0)
    first = made.step(State(q, V), AccelerationRange(-WIDE, WIDE))
    friction = made.find(Friction).last
    assert (np.abs(friction) <= 1.01 * DT / 0.2 * MODEL.level(V)).all()
    assert np.abs((first.tau - tau) / ARM.tau_max).max() < 0.01
    steps(made, 2000)
    full = WANTED * MODEL.level(V)
    np.testing.assert_allclose(made.find(Friction).last[FIRM], full[FIRM], rtol=1e-2)


def test_what_comes_after_a_gap_or_a_jump_does_not_kick():
    made = controller(mode="joints")
    before = steps(made, 500)
    for elapsed in (0.4, 0.0, -1.0, math.nan):
        w = made.find(Friction).reference_velocity.copy()
        tau = made.step(State(ARM.q_start, V), AccelerationRange(-WIDE, WIDE), None, elapsed).tau
        np.testing.assert_array_equal(made.find(Friction).reference_velocity, w)
        assert np.abs((tau - before.tau) / ARM.tau_max).max() < 2e-3
    # A glitch of the sensor, by which friction would be more than the budget.
    made.step(State(ARM.q_start, V + 200.0), AccelerationRange(-WIDE, WIDE))
    assert (np.abs(made.find(Friction).last) <= ON.budget).all()


# Parameters


@dataclass(frozen=True, eq=False, kw_only=True)
class Parameters(RobotConfiguration):
    friction: FrictionConfiguration = group(FrictionConfiguration)


def settings(**changed):
    made = read(Parameters, read_config("panda", NODE) | changed)
    return made.friction.settings(ARM.tau_max)


def test_defaults_are_off():
    made = settings()
    assert made.scale == 0.0
    assert made.model.level(np.ones(N)).max() == 0.0
    np.testing.assert_allclose(made.budget, 0.2 * ARM.tau_max)


def test_each_parameter_reaches_the_settings():
    rows = {
        "friction_model_coulomb": COULOMB,
        "friction_model_static": 1.3 * COULOMB,
        "friction_model_viscous": 0.2 * COULOMB,
        "friction_model_stribeck_velocity": np.full(N, 0.07),
    }
    made = settings(
        friction_compensation=0.4,
        **{key: value.tolist() for key, value in rows.items()},
    )
    assert made.scale == 0.4
    for name, expected in rows.items():
        np.testing.assert_array_equal(
            getattr(made.model, name.removeprefix("friction_model_")), expected
        )
    only = settings(friction_model_coulomb=COULOMB.tolist())
    np.testing.assert_array_equal(only.model.static, COULOMB)
    np.testing.assert_array_equal(only.model.viscous, 0.0)
    np.testing.assert_array_equal(only.model.stribeck_velocity, 0.01)


REFUSED = [
    ("friction_compensation", 1.1, ">= 0 and <= 1"),
    ("friction_compensation", -0.1, ">= 0 and <= 1"),
    ("friction_compensation", math.nan, ">= 0 and <= 1"),
    ("friction_compensation", "on", "a number"),
    ("friction_model_coulomb", [1.0] * (N - 1), f"{N} numbers"),
    ("friction_model_coulomb", [-1.0] * N, ">= 0"),
    ("friction_model_coulomb", [math.inf] * N, "finite"),
    ("friction_model_static", [0.01] * N, "at least friction_model_coulomb"),
    ("friction_model_viscous", [math.nan] * N, "finite"),
    ("friction_model_stribeck_velocity", [0.0] * N, "> 0"),
]
GIVEN = {
    "friction_compensation": 0.5,
    "friction_model_coulomb": COULOMB.tolist(),
    "friction_model_static": (1.3 * COULOMB).tolist(),
}


@pytest.mark.parametrize(("name", "value", "allowed"), REFUSED)
def test_what_cannot_be_is_refused_by_name(name, value, allowed):
    with pytest.raises(SettingError, match=f"parameter '{name}' is .*{re.escape(allowed)}"):
        settings(**GIVEN | {name: value})


def test_there_must_be_a_model_to_compensate():
    with pytest.raises(SettingError, match="0 as long as no friction_model_coulomb"):
        settings(friction_compensation=0.5)


class FrictionChain(ControllerChain):
    """A robot that stands at one place, and its bounds node, in front of the real node."""

    def __init__(self, ros, **changed) -> None:
        given = read_config("panda", NODE) | {"bounds_timeout": 20.0, "state_timeout": 40.0}
        # Joints that stand and have a speed: the estimator would refuse them.
        super().__init__(ros, given | {"use_estimated_states": True} | changed)
        self.stamp = 0

    def answer(self) -> np.ndarray:
        """Return the torques for the next period."""
        self.stamp += round(1e3 * ARM.dt)
        stamp = self.stamp

        def send():
            self.send_limits(stamp, -WIDE, WIDE)
            self.send_state(stamp, ARM.q_start, V)

        return np.array(self.await_command(stamp, send).effort)


def test_it_is_switched_while_the_node_runs(ros):
    chain = FrictionChain(ros, **GIVEN | {"friction_compensation": 0.0})
    torques = [chain.answer() for _ in range(2)]
    ros.accepts(NODE, friction_compensation=1.0)
    torques += [chain.answer() for _ in range(60)]
    # Nothing is viscous, and V too fast for stiction.
    share = 1.0 - math.exp(-60 * ARM.dt / 0.2)
    wanted = share * WANTED * COULOMB
    np.testing.assert_allclose((torques[-1] - torques[1])[FIRM], wanted[FIRM], atol=1e-3)
    most = 1.1 * ARM.dt / 0.2 * COULOMB
    assert (np.abs(torques[2] - torques[1]) < most).all()
    ros.wait_until(
        lambda: (
            float((ros.reported(NODE, "friction_torque_nm") or "0").split()[0])
            == pytest.approx(wanted[0], abs=1e-3)
        ),
        "the diagnostics",
    )
    ros.accepts(NODE, friction_compensation=0.0)
    after = [chain.answer() for _ in range(60)]
    assert (np.abs(after[0] - torques[-1]) < most)[FIRM].all()
    left = (1.0 - share) * wanted
    np.testing.assert_allclose((after[-1] - torques[1])[FIRM], left[FIRM], atol=1e-3)


def test_what_cannot_be_is_refused_while_the_node_runs(ros):
    chain = FrictionChain(ros, **GIVEN)
    before = chain.node.get_parameter("friction_compensation").value
    for name, value, allowed in REFUSED:
        reason = ros.refuses(NODE, **{name: value})
        assert names_parameter(reason, name)
        assert allowed in reason or "out of range" in reason
    assert chain.node.get_parameter("friction_compensation").value == before
