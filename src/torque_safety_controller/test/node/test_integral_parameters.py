# SPDX-License-Identifier: Apache-2.0
"""The controller node with integral action: its parameters, at start and live."""

from __future__ import annotations

import numpy as np
import pytest
from arms import load_arm
from controller_chain import NODE, ControllerChain, controller_of, gains_of, patient_values
from controllers import make

from torque_safety_controller.controller import Controller
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parts.integral import Integral, make_integral
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import names_parameter

ARM = load_arm("panda")
PERIOD = round(1e3 * ARM.dt)  # ms
VALUES = patient_values("panda", disturbance_time=0.0, integral_action="joints")
N = ARM.n
Q = ARM.q_start
WIDE = np.full(N, 50.0)
# Of states at one place: what the arm does not do as it is told, the integral sees.
SPEEDS = (
    0.02 * ARM.v_max * np.array([[1], [-1], [0.5], [-2], [1]]) * np.sign(0.5 - np.arange(N) % 2)
)
SAME_TORQUE = 1e-6  # N m
SMALL = (0.001 * ARM.tau_max).tolist()
SMALL_BUDGET = {"budget": np.array(SMALL)}
TASK = {"mode": "task"}


def make_settings(**changed) -> IntegralSettings:
    return IntegralSettings(**{"budget": 0.1 * ARM.tau_max} | changed)


def core(mode="joints", **changed) -> Controller:
    """The node's core, set up by hand; also says what its defaults are."""
    integral = make_integral(mode, make_settings(**changed), 2.0 * ARM.tau_max)
    controller = make(ARM, gains=gains_of(VALUES), integral=integral)
    controller.reset(Q)
    return controller


def torque(controller, v) -> np.ndarray:
    return controller.step(State(Q, v), AccelerationRange(-WIDE, WIDE)).tau


def torques(controller) -> np.ndarray:
    return np.array([torque(controller, v) for v in SPEEDS])


@pytest.mark.parametrize(
    ("changed", "by_hand", "without"),
    [
        ({}, {}, {"mode": "none"}),
        ({"integral_action": "task"}, TASK, {}),
        ({"integral_action": "position"}, {"mode": "position"}, TASK),
        ({"integral_budget": SMALL}, SMALL_BUDGET, {}),
        ({"integral_lambda": 8.0}, {"gain": 8.0}, {}),
        (
            {"integral_anti_windup": "scaling", "integral_budget": SMALL},
            SMALL_BUDGET | {"anti_windup": "scaling"},
            SMALL_BUDGET,
        ),
        (
            {"integral_action": "task", "integral_anti_windup": "paper"},
            TASK | {"anti_windup": "paper"},
            TASK,
        ),
    ],
    ids=lambda value: " ".join(value),
)
def test_each_parameter_reaches_the_torque(changed, by_hand, without):
    controller = controller_of(VALUES | changed)
    controller.reset(Q)
    found = torques(controller)
    np.testing.assert_allclose(found, torques(core(**by_hand)), atol=SAME_TORQUE)
    assert np.abs(found - torques(core(**without))).max() > 20.0 * SAME_TORQUE


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("integral_action", "plain", "one of none, joints, task, position"),
        ("integral_budget", [-1.0, *ARM.tau_max[1:]], ">= 0"),
        ("integral_budget", [87.1, *ARM.tau_max[1:]], "at most torque_max"),
        ("integral_lambda", 0.5, ">= 1"),
        ("integral_anti_windup", "qp2", "one of qp, paper, scaling"),
    ],
)
def test_bad_parameters_are_refused(name, value, allowed):
    with pytest.raises(SettingError) as refused:
        controller_of(VALUES | {name: value})
    assert refused.value.name == name
    assert allowed in refused.value.allowed


def test_six_joints_have_a_null_space_of_a_position_and_none_of_a_pose():
    cut = {k: v[:6] for k, v in VALUES.items() if isinstance(v, list) and len(v) == N}
    values = VALUES | cut | {"end_effector_frame": "panda_link6"}
    controller_of(values | {"integral_action": "position"})
    with pytest.raises(SettingError) as refusal:
        controller_of(values | {"integral_action": "task"})
    assert str(refusal.value) == (
        "parameter 'integral_action' is 'task'; allowed: 'none' or 'joints': "
        "6 joints have no null space left of the task"
    )


class IntegralChain(ControllerChain):
    """A controller that is asked for torques, one period after the other."""

    def __init__(self, ros, **changed) -> None:
        super().__init__(ros, VALUES | changed)
        self.stamp = 10 * PERIOD

    def answer(self, v, period=PERIOD) -> np.ndarray:
        """Return the torques for the next state."""
        self.stamp += period
        return np.array(self.ask(self.stamp, Q, v).effort)


def test_parameters_change_while_it_runs_and_the_torque_goes_on(ros):
    chain, controller = IntegralChain(ros), core()
    common = {}
    for changed, by_hand in (
        ({}, {}),
        ({"integral_lambda": 8.0}, {"gain": 8.0}),
        ({"integral_budget": SMALL}, {"budget": np.array(SMALL)}),
    ):
        ros.accepts(NODE, **changed)
        common |= by_hand
        controller.find(Integral).action.settings = make_settings(**common)
        before = controller.find(Integral).action.last
        for k, v in enumerate(SPEEDS):
            expected = torque(controller, v)
            found = chain.answer(v)
            np.testing.assert_allclose(
                found, expected, atol=SAME_TORQUE, err_msg=f"{changed}, {k}"
            )
            if changed and k == 0:  # the same state as the last one, but for v
                change = controller.find(Integral).action.last - before
                assert (np.abs(change) < 0.01 * ARM.tau_max).all(), changed
    # What is refused changes nothing.
    for name, value in (("integral_budget", [1.0]), ("integral_lambda", 0.5)):
        assert names_parameter(ros.refuses(NODE, **{name: value}), name)
    for name, value in (("integral_action", "task"), ("integral_anti_windup", "paper")):
        assert "read-only" in ros.refuses(NODE, **{name: value})
    np.testing.assert_allclose(
        chain.answer(SPEEDS[0]), torque(controller, SPEEDS[0]), atol=SAME_TORQUE
    )


@pytest.mark.parametrize("gap", [3 * PERIOD, 100_000])
def test_a_robot_that_pauses_or_whose_clock_jumps_gets_no_kick(ros, gap):
    chain = IntegralChain(ros, integral_lambda=30.0)
    for _ in range(20):
        before = chain.answer(SPEEDS[3])
    ros.wait_until(lambda: chain.reported("steps") == "20")
    added = np.array(chain.reported("additional_torque_nm").split(), float)
    assert np.abs(added / ARM.tau_max).max() > 0.01
    after = chain.answer(SPEEDS[3], gap)
    assert (np.abs(after - before) < 1e-3 * ARM.tau_max).all()
    assert (np.abs(chain.answer(SPEEDS[3]) - after) < 5e-3 * ARM.tau_max).all()
    ros.wait_until(lambda: chain.reported("integral_skipped_steps") == "1")
