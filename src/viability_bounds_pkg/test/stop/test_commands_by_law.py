# SPDX-License-Identifier: Apache-2.0
"""Commands that a drive's law lets through: held too long, and returning after a stop."""

import numpy as np
import pinocchio as pin
import pytest
from stopping_arm import Arm, H

PASS_STEPS, RETURN_STEPS = 50, 100  # docs/theory/whole_arm.md: 50 ms, 0.1 s


@pytest.fixture(scope="module")
def arm():
    return Arm("talos_left_arm")


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_no_command_held_for_however_long_passes_a_limit(robot):
    """From the edge of the kernel, under torques at their limits that change at random."""
    arm, rng = Arm(robot), np.random.default_rng(0)
    stop, asked = arm.stop(), 0.0
    for _ in range(5):
        q, v = arm.edge(rng)
        stop.start(q, v)
        for step in range(300):
            if step % 25 == 0:
                command = arm.tau_max * rng.choice([-1.0, 1.0], arm.n)
            tau = stop.follow(q, v, command)
            assert (np.abs(tau) <= arm.tau_max).all()
            asked = max(asked, np.abs(command - tau).max())
            q, v = arm.move(q, v, tau)
            assert arm.beyond(q).max() == 0.0
            assert (np.abs(v) <= arm.limits.v_max).all()
    assert asked > 1.0, "the law had nothing to do"


@pytest.mark.parametrize("within", [True, False])
def test_commands_act_by_themselves_once_the_limits_let_them_through(arm, within):
    """Others never: who sends them has a wrong idea of the arm."""
    rng = np.random.default_rng(1)
    q, v = arm.inside(rng)
    stop = arm.stop(observer_time=0.002)
    stop.start(q, v)
    for k in range(3 * PASS_STEPS):
        a = rng.uniform(-1.0, 1.0, arm.n) if within else 1.2 * arm.limits.a_max
        command = pin.rnea(arm.model, arm.data, q, v, a)
        tau = stop.follow(q, v, command)
        assert stop.returned == (within and k + 1 >= PASS_STEPS)
        if within:
            assert tau == pytest.approx(command, abs=2e-3 * arm.tau_max.max())
        q, v = arm.move(q, v, tau)


@pytest.mark.parametrize("rests", [False, True])
def test_a_command_after_a_stop_takes_effect_without_a_step(arm, rests):
    """It returns in the middle of the stop, or after it."""
    rng = np.random.default_rng(2)
    stop = arm.stop(observer_time=0.002)
    q, v = arm.inside(rng)
    stop.start(q, v)
    last = stop.torque(q, v)
    while rests and not stop.at_rest:
        q, v = arm.move(q, v, last)
        last = stop.torque(q, v)
    wish = np.where(rng.random(arm.n) < 0.5, arm.limits.a_min, arm.limits.a_max)
    steps, first, largest = 0, 0.0, 0.0
    while not stop.returned:
        q, v = arm.move(q, v, last)
        # It turns, so that the arm stays away from its limits.
        command = pin.rnea(arm.model, arm.data, q, v, wish * np.cos(20.0 * H * steps))
        first = first or np.abs((command - last) / arm.tau_max).max()
        tau = stop.follow(q, v, command)
        largest = max(largest, np.abs((tau - last) / arm.tau_max).max())
        last, steps = tau, steps + 1
    assert steps == RETURN_STEPS
    assert first > 0.1, "there was no step to avoid"
    assert largest < 0.2 * first
    assert tau == pytest.approx(command, abs=5e-3 * arm.tau_max.max())


@pytest.mark.parametrize("known", [True, False])
def test_friction_that_is_known_when_the_law_takes_over_is_no_step(arm, known):
    """A command that balances friction, held for a period; in motion and at rest."""
    rng = np.random.default_rng(4)
    stop, largest = arm.stop(observer_time=0.002), 0.0
    for speed in (0.0, 0.2):
        q, v = arm.inside(rng)
        v = speed * v
        friction = 0.1 * arm.tau_max * rng.choice([-1.0, 1.0], arm.n)
        a = rng.uniform(-1.0, 1.0, arm.n)
        command = pin.rnea(arm.model, arm.data, q, v, a) + friction
        stop.start(q, v, *((command, a) if known else ()))
        steps = np.abs(stop.follow(q, v, command) - command) / arm.tau_max
        largest = max(largest, float(steps.max()))
    assert largest < 1e-3 if known else largest > 0.03
