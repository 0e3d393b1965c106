# SPDX-License-Identifier: Apache-2.0
"""States that lie at any moment: frozen, also where the arm stands, a part of them, exchanged."""

from collections.abc import Callable
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import pytest
from direct import DirectLoop, posture_at_limits

from sim_bridge.nodes.bullet_parameters import make_stop
from torque_safety_controller.node.assembly import make_state_check
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.safety.rate_watch import RateWatch
from torque_safety_controller.supervisor import Order
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import UNDECIDED

HASTE = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
LASTS = 0.6  # s of a fault

Lie = Callable[[State, State], State]
"""Returns what is said of a state; the second one is that in which the fault began."""


def frozen(state: State, first: State) -> State:
    return first


class Played(NamedTuple):
    """What happened: how far limits were passed, rad and rad/s, and when lies were told.

    `after` has for each fault that was told the number of the state, 1 for the first that was
    wrong; `again` the time from its end until states were believed, s.
    """

    position: float
    speed: float
    faults: int
    after: list[int]
    again: list[float]


def play(
    robot: str,
    seed: int,
    lie: Lie = frozen,
    told: bool = True,
    seconds: float = 12.5,
    apart: float = 3.5,
    wander: float = 0.5,
    goals: float = 2.0,
    first_at: float = 2.0,
    **changed: Any,
) -> Played:
    """Let faults begin `apart` s from each other, as a node's states would be treated.

    Each is up to `wander` s late. Fewer than 2.5 s from one to the next are taken for one fault.
    With goals 2 s apart the arm stands in about half of the faults when they begin. States that
    are refused are not answered, and the robot stops itself; one that is undecided costs a period.
    `changed` are parameters that differ from the robot's file.
    """
    rng = np.random.default_rng(seed)
    loop = DirectLoop(robot, HASTE | changed)
    config, arm, law = loop.config, loop.robot, make_stop(loop.config)
    check = make_state_check(loop._controller_configuration(), loop.model, None)
    watch, low, high = RateWatch(config.dt, 1), config.position_min, config.position_max
    tau, in_row, answered = np.zeros(low.size), 0, 0.0
    begins = first_at + apart * np.arange(int((seconds - first_at) / apart))
    begins += rng.uniform(0.0, wander, begins.size)
    first, after, again = None, {}, {}
    with closing(arm):
        for k in range(round(seconds / config.dt)):
            t = k * config.dt
            if k % round(goals / config.dt) == 0:
                loop.controller.set_posture_goal(posture_at_limits(rng, low, high))
            q, v, _ = arm.state()
            state = State(q.copy(), v.copy())
            last = int(np.count_nonzero(begins <= t)) - 1
            if last >= 0 and t < begins[last] + LASTS:
                first = first or state
                state = lie(state, first)
            else:
                first = None
            wrong = check.look(state, 1.0 + t) if told else ""
            if wrong == UNDECIDED:
                tau = loop.controller.go_on()
            elif wrong:
                watch.slow(wrong)
                in_row += 1
            else:
                in_row = 0
                watch.note(t - answered)
                answered, order = t, Order(watch.share)
                bounds = AccelerationRange(*loop.bounds(*state)[:2])
                tau = loop.controller.step(state, bounds, order, config.dt).tau
                check.expect(loop.controller.expected())
            if first and wrong and wrong != UNDECIDED:
                after.setdefault(last, int((t - begins[last]) / config.dt) + 1)
            elif not first and not wrong and last in after:
                again.setdefault(last, t - begins[last] - LASTS)
            loop.act(law, tau, in_row)
        position = float(arm.monitor.max_position_violation.max())
        speed = float(arm.monitor.max_velocity_violation.max())
        return Played(position, speed, begins.size, list(after.values()), list(again.values()))


@pytest.mark.parametrize(
    "robot", [pytest.param("panda", marks=pytest.mark.long), "baxter_left_arm"]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_they_are_told_before_a_limit_is_passed(robot, seed):
    played = play(robot, seed)
    assert played.position == 0.0 and played.speed == 0.0
    dt = DirectLoop(robot).dt
    assert len(played.after) == played.faults and max(played.after) * dt < 0.1


@pytest.mark.long
def test_untold_they_pass_limits():
    played = play("panda", 0, told=False)
    assert played.position > 0.1 or played.speed > 0.5


LIES = {
    f"velocities with a bias of {bias}": lambda state, first, bias=bias: state._replace(
        v=state.v + bias
    )
    for bias in (-1.5, -0.2, 0.08, 0.6)
}
# When sensors are known, and as near to each other as they may be: 2 s are most of what is played.
IN_MOTION = {"seconds": 29.0, "apart": 2.6, "wander": 0.1, "goals": 0.7, "first_at": 3.0}
LIES["positions frozen"] = lambda state, first: state._replace(q=first.q)


def test_the_period_of_a_state_that_is_undecided_passes_no_limit():
    """A torque that was held, at 250 Hz and a speed limit, passed it by 4 mrad/s."""
    played = play("panda", 17, LIES["positions frozen"], **IN_MOTION, rate_hz=250.0)
    assert played.position == 0.0 and played.speed == 0.0
    assert len(played.after) == played.faults


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize(
    "robot",
    [
        pytest.param("panda", marks=pytest.mark.long),
        pytest.param("talos_left_arm", marks=pytest.mark.long),
        "baxter_left_arm",
    ],
)
def test_positions_that_contradict_velocities_are_told_by_the_second(robot, lie):
    """In motion: positions that froze are right in the first state."""
    played = play(robot, 3, LIES[lie], **IN_MOTION)
    assert played.position == 0.0 and played.speed == 0.0
    assert len(played.after) == played.faults == 10
    assert max(played.after) <= 2 + (lie == "positions frozen")
    assert max(played.again) < 1.0


def nearest_exchanged(state: State, first: State) -> State:
    """Exchange the two joints that are nearest to each other, of those that can be told apart."""
    apart = np.abs(first.q[:, None] - first.q[None, :])
    apart[apart < 1e-3] = np.inf
    i, j = np.unravel_index(np.argmin(apart), apart.shape)
    order = np.arange(first.q.size)
    order[[i, j]] = j, i
    return State(state.q[order], state.v[order])


@pytest.mark.parametrize(
    "robot",
    [
        pytest.param("panda", marks=pytest.mark.long),
        pytest.param("talos_left_arm", marks=pytest.mark.long),
        "baxter_left_arm",
    ],
)
def test_joints_that_are_exchanged_are_told_and_never_believed(robot):
    """In motion, mrad apart; what leapt once has to leap back."""
    played = play(robot, 4, nearest_exchanged, **IN_MOTION)
    assert played.position == 0.0 and played.speed == 0.0
    assert len(played.after) == played.faults == 10
    assert max(played.after) <= 2
    assert len(played.again) == 10 and max(played.again) < 1.0


def test_joints_that_are_exchanged_are_told_after_torques_have_braked_a_wrist_hard():
    """The filter of the whole arm changes the speed of a wrist by 1 rad/s in a period of 10 ms."""
    played = play(
        "baxter_left_arm", 3, nearest_exchanged, seconds=36.0, apart=3.1, goals=0.7, first_at=4.0
    )
    assert played.position == 0.0 and played.speed == 0.0
    assert len(played.after) == len(played.again) == played.faults == 10
    assert max(played.after) <= 2


IMPOSSIBLE = {
    "velocities a hundred times as large": lambda state, first: state._replace(
        v=100.0 * state.v + 30.0
    ),
    "zeros": lambda state, first: State(0.0 * state.q, 0.0 * state.v),
    "joints in another order": lambda state, first: State(*(each[::-1].copy() for each in state)),
}


@pytest.mark.parametrize("lie", IMPOSSIBLE)
@pytest.mark.parametrize("seed", [3, 4])
def test_an_arm_of_weak_motors_that_stopped_meanwhile_goes_on(lie, seed):
    """Its stop moves joints that stood."""
    played = play("baxter_left_arm", seed, IMPOSSIBLE[lie], **IN_MOTION)
    assert played.position == 0.0 and played.speed == 0.0
    assert len(played.after) == len(played.again) == played.faults == 10
    assert max(played.after) == 1 and max(played.again) < 1.0


def test_lies_before_sensors_are_known_are_forgotten():
    """The first one is told late; it does not teach that sensors are so bad."""
    lie = LIES["velocities with a bias of 0.6"]
    played = play("baxter_left_arm", 3, lie, seconds=20.0, apart=6.0, goals=0.7, first_at=1.0)
    assert len(played.after) == len(played.again) == played.faults == 3
    assert played.after[0] > 3 and max(played.after[1:]) <= 2
    assert max(played.again) < 1.0
