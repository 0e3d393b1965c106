# SPDX-License-Identifier: Apache-2.0
"""Friction of the simulated TALOS: told from a recording, and compensated."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest
from direct import DirectLoop, column

from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from sim_bridge.tools.record_excitation import excitation, record
from torque_safety_controller.friction.identification import friction_model, identify
from torque_safety_controller.friction.joint_recording import Recording
from torque_safety_controller.friction.settings import GAIN
from torque_safety_controller.parts.friction import Friction
from torque_safety_controller.tasks.gains import critical_damping
from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

pytestmark = pytest.mark.long

ROBOT = "talos_left_arm"
GIVEN = read_config(ROBOT, "bullet_node")
N = len(GIVEN["joints"])
MODEL = ("coulomb", "static", "viscous")
STILL = 1e-4  # rad/s
THETA = 3.0  # 1/s, the default


@pytest.fixture(scope="module")
def found():
    """The friction found in 36 s of motion of arms 10% heavier than the model."""
    config = read(BulletConfiguration, GIVEN)
    assert set(GIVEN["mass_scales"]) == {1.1}
    motion = excitation(config, config.start_positions, config.dt)
    with closing(make_robot(config)) as robot:
        recorded, monitor = record(robot, config, *motion)
    assert not monitor.violated
    model = read_robot(config_folder() / f"{ROBOT}.yaml").model
    fits = list(identify(model, Recording(**recorded)))
    assert [fit.notes for fit in fits] == [[]] * N
    return friction_model(fits)


@pytest.mark.parametrize(
    ("name", "true", "within"),
    [
        ("coulomb", "friction_coulomb", 0.05),
        ("viscous", "friction_viscous", 0.05),
        ("static", "friction_static", 0.1),
        ("stribeck_velocity", "stribeck_velocity", 0.1),
    ],
)
def test_friction_is_identified_despite_wrong_masses(found, name, true, within):
    np.testing.assert_allclose(getattr(found, name), GIVEN[true], rtol=within)


def test_the_file_has_what_is_identified(found):
    controller = read_config(ROBOT, "controller_node")
    assert controller["friction_compensation"] == 0.0
    for name in (*MODEL, "stribeck_velocity"):
        written = controller[f"friction_model_{name}"]
        np.testing.assert_allclose(getattr(found, name), written, rtol=0.01)


def loop(integral, share) -> DirectLoop:
    """TALOS that believes in `share` of its friction and compensates that; 0: off."""
    made = DirectLoop(ROBOT, {"integral_action": integral})
    model = made.controller.find(Friction).settings.model
    believed = {f"friction_model_{name}": share * getattr(model, name) for name in MODEL}
    if share:
        made.change(friction_compensation=1.0, **believed)
    return made


def reach(made) -> tuple[float, float, float]:
    """Return the error that remains, m, the speed that remains, rad/s, and the largest torque."""
    home = made.pose()
    worst = speed = 0.0
    for goal in (home * pin.SE3(np.eye(3), np.array([0.06, -0.08, 0.05])), home):
        made.controller.goals.set_pose(goal)
        last = made.run(2.5)[-300:]
        worst = max(worst, np.linalg.norm(column(last, "error")[:, :3], axis=1).max())
        speed = max(speed, np.abs(column(last, "v")).max())
    monitor = made.robot.monitor
    assert monitor.max_position_violation.max() == 0.0
    assert monitor.max_velocity_violation.max() == 0.0
    return worst, speed, monitor.max_torque_ratio.max()


def test_a_pose_is_reached_and_kept_without_a_limit_cycle():
    without = reach(loop("none", 0.0))[0]
    assert 3e-3 < without < 2e-2
    for share, better in ((0.7, 1.5), (1.0, 8.0), (1.3, 8.0)):
        error, speed, torque = reach(loop("none", share))
        assert error < without / better, share
        assert speed < STILL, share
        assert torque <= 1.0 + 1e-9


def test_it_does_not_hunt_with_the_integral():
    """The integral alone leaves less than a quarter of a millimetre here, too."""
    for share in (0.0, 0.7, 1.3):
        error, _, torque = reach(loop("joints", share))
        assert error < 2.5e-4, share
        assert torque <= 1.0 + 1e-9


@pytest.mark.parametrize("robot", ["talos_left_arm", "panda", "baxter_left_arm"])
def test_the_gain_leaves_room_for_sampling_and_delay(robot):
    """As long as w does not call for all of the friction, the loop is linear.

    Without any friction to damp it, it is stable with a torque that is a period late, in
    configurations all over the range.
    """
    values = read_config(robot, "controller_node")
    kp, kd, dt = values["pose_kp"], values["pose_kd"], 1.0 / values["rate_hz"]
    kd = critical_damping(kp) if kd == -1.0 else kd
    described = read_robot(config_folder() / f"{robot}.yaml")
    data = described.model.createData()
    rng = np.random.default_rng(0)
    couplings = []
    for _ in range(200):
        q = rng.uniform(described.q_min, described.q_max)
        M = pin.crba(described.model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        couplings.extend(np.linalg.eigvals(np.linalg.inv(M) / np.diag(np.linalg.inv(M))).real)
    assert 1.5 < max(couplings) < 4.0
    radii = [radius(GAIN / dt * c, kp, kd, THETA, dt, delay=1) for c in couplings]
    assert max(radii) < 1.0
    # With five times the gain it would not be.
    largest = 5.0 * GAIN / dt * max(couplings)
    assert radius(largest, kp, kd, THETA, dt, delay=1) > 1.0


def radius(gamma, kp, kd, theta, dt, delay):
    """Spectral radius of a mode: x' = v, v' = a + gamma w, w' = a - theta (w - v) per period."""
    size = 3 + delay
    A = np.zeros((size, size))
    a = np.zeros(size)
    a[:2] = -kp, -kd
    torque = a.copy()
    torque[2] += gamma
    A[:3, :3] = np.eye(3)
    acting = torque if delay == 0 else np.eye(size)[size - 1]
    A[1] += dt * acting
    A[0, 1] += dt
    A[0] += 0.5 * dt**2 * acting
    A[2] += dt * a
    A[2, 1] += dt * theta
    A[2, 2] -= dt * theta
    for k in range(delay):
        A[3 + k] = torque if k == 0 else np.eye(size)[2 + k]
    return np.abs(np.linalg.eigvals(A)).max()
