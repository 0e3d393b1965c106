# SPDX-License-Identifier: Apache-2.0
"""Commands that a drive's law lets through: held too long, and returning after a stop."""

import numpy as np
import pinocchio as pin
import pytest
from stopping_arm import Arm, H

from viability_bounds_pkg.stop import PASS_TIME, RETURN_TIME


@pytest.fixture(scope="module", params=["panda", "talos_left_arm"])
def arm(request):
    return Arm(request.param)


def test_no_command_held_for_however_long_passes_a_limit(arm):
    """From the edge of the kernel, under torques at their limits that change at random."""
    rng = np.random.default_rng(0)
    stop, asked = arm.stop(), 0.0
    for _ in range(10):
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


def test_a_command_within_the_limits_passes_unchanged(arm):
    rng = np.random.default_rng(1)
    q, v = arm.inside(rng)
    stop = arm.stop(observer_time=0.002)
    stop.start(q, v)
    for k in range(60):
        a = rng.uniform(-1.0, 1.0, arm.n)
        command = pin.rnea(arm.model, arm.data, q, v, a)
        tau = stop.follow(q, v, command)
        assert stop.returned == ((k + 1.5) * H > PASS_TIME)  # it may act by itself then
        assert tau == pytest.approx(command, abs=2e-3 * arm.tau_max.max())
        q, v = arm.move(q, v, tau)


def test_commands_that_pass_a_limit_do_not_act_by_themselves(arm):
    """However long they last: for who sends them has a wrong idea of the arm."""
    rng = np.random.default_rng(3)
    q, v = arm.inside(rng)
    stop = arm.stop(observer_time=0.002)
    stop.start(q, v)
    for _ in range(3 * round(PASS_TIME / H)):
        command = pin.rnea(arm.model, arm.data, q, v, 1.2 * arm.limits.a_max)
        q, v = arm.move(q, v, stop.follow(q, v, command))
        assert not stop.returned


def test_a_command_after_a_stop_takes_effect_without_a_step(arm):
    rng = np.random.default_rng(2)
    stop = arm.stop(observer_time=0.002)
    for moving in (True, False):  # the command returns in the middle of the stop, or after it
        q, v = arm.inside(rng)
        stop.start(q, v)
        last = stop.torque(q, v)
        while not (moving or stop.at_rest):
            q, v = arm.move(q, v, last)
            last = stop.torque(q, v)
        assert not stop.returned
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
        assert steps == round(RETURN_TIME / H)
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
