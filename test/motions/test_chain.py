# SPDX-License-Identifier: Apache-2.0
"""Bounds, controller and robot node together, over real DDS, in lockstep."""

import chain
import numpy as np
import pinocchio as pin
import pytest
import yaml
from chain import load_values, run_chain

from viability_bounds_pkg.parameter_files import YamlError
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.testing.ros_harness import config_folder

ROBOTS = ("baxter_left_arm", "panda")


def pose_events(values, rng, times):
    """Goals at the poses of random configurations: some way off, often behind a limit."""
    model = build_model(read_urdf(values["robot_description"]), values["joints"])
    data = model.createData()
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    base = model.getFrameId(values["base_frame"])
    hand = model.getFrameId(values["end_effector_frame"])
    for time in times:
        pin.framesForwardKinematics(model, data, rng.uniform(low, high))
        pose = data.oMf[base].actInv(data.oMf[hand])
        orientation = pin.Quaternion(pose.rotation).coeffs()
        yield {
            "time": time,
            "pose": {
                "position": pose.translation.tolist(),
                "orientation": (orientation / np.linalg.norm(orientation)).tolist(),
            },
        }


def assert_no_limit_broken(result):
    assert result.vector("position_violation_rad").max() == 0.0
    assert result.vector("velocity_violation_rad_s").max() <= 1e-9
    assert result.vector("torque_ratio").max() <= 1.0 + 1e-9
    assert float(result.robot["commanded_torque_ratio_max"]) <= 1.0 + 1e-9
    assert int(result.robot["braked_periods"]) == 0
    # On a busy machine a state may be sent twice, and the second command comes too late.
    assert "not finite" not in result.robot["commands_refused"]
    assert "wrong size" not in result.robot["commands_refused"]


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(
    ("seed", "rate"),
    [(0, None), (1, None), pytest.param(3, 1000.0, marks=pytest.mark.long)],
)
def test_random_goals_never_break_a_limit(robot, seed, rate):
    rng = np.random.default_rng(seed)
    values = load_values(robot)
    values["rate_hz"] = rate or values["rate_hz"]
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    values["start_positions"] = (
        0.5 * (low + high) + 0.2 * (high - low) * rng.uniform(-1.0, 1.0, len(low))
    ).tolist()
    # Every joint is made to hurry.
    values["pose_kp"] = 100.0
    events = list(pose_events(values, rng, (0.0, 0.8, 1.6)))
    result = run_chain(values, {"duration": 2.4, "events": events}, {})
    assert_no_limit_broken(result)
    speeds = np.abs(result.run.v) / values["velocity_max"]
    assert speeds.max() > 0.9, "the arm was hardly driven"
    assert result.run.lost <= 1  # the last state, which nobody answers any more


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("goal", [True, False])
def test_an_arm_outside_its_limits_moves_back_in(robot, goal):
    values = load_values(robot)
    start = list(values["start_positions"])
    # The second joint carries the most; one goes beyond its upper, one beyond its lower limit.
    start[4] = values["position_max"][4] + 0.05
    start[6] = values["position_min"][6] - 0.03
    values["start_positions"] = start
    inside = dict(zip(values["joints"], load_values(robot)["start_positions"], strict=True))
    events = [{"time": 0.0, "posture": inside}] if goal else []
    result = run_chain(values, {"duration": 1.5, "events": events}, {})
    q = result.run.q
    # The first state has it outside, no later one further.
    outside = result.vector("position_violation_rad")
    assert outside[4] == pytest.approx(0.05, abs=1e-4)
    assert outside[6] == pytest.approx(0.03, abs=1e-4)
    assert (q[-1] < values["position_max"]).all()
    assert (q[-1] > values["position_min"]).all()
    assert (np.diff(q[:50, 4]) <= 1e-9).all()
    assert result.vector("velocity_violation_rad_s").max() <= 1e-9
    assert result.vector("torque_ratio").max() <= 1.0 + 1e-9


def test_naive_bounds_break_the_limits_that_exact_ones_keep():
    values = load_values("baxter_left_arm")
    scenario = yaml.safe_load(
        (config_folder() / "scenarios" / "baxter_left_arm_demo.yaml").read_text()
    )
    scenario = {"duration": 1.0, "events": scenario["events"][:1]}
    elbow = values["joints"].index("left_e1")
    assert_no_limit_broken(run_chain(values, scenario, {}))
    alone = {"bounds_node": {"method": "naive"}, "controller_node": {"safety_filter": False}}
    naive = run_chain(values, scenario, alone)
    violation = naive.vector("position_violation_rad")
    assert violation.argmax() == elbow
    assert violation[elbow] > 0.01  # rad


def test_the_same_run_gives_the_same_numbers():
    values = load_values("baxter_left_arm")
    events = list(pose_events(values, np.random.default_rng(7), (0.0, 0.4)))
    runs = [run_chain(values, {"duration": 0.8, "events": events}, {}).run for _ in range(2)]
    for name in ("t", "q", "v", "a_lower", "a_upper", "tau"):
        np.testing.assert_array_equal(*(getattr(run, name) for run in runs))


def test_a_push_is_felt_and_survived():
    values = load_values("panda")
    push = {"link": "panda_link5", "duration": 0.3, "force": [0.0, 25.0, 0.0]}
    events = [{"time": 0.2, "push": push}]
    still = run_chain(values, {"duration": 1.0, "events": []}, {})
    pushed = run_chain(values, {"duration": 1.0, "events": events}, {})
    assert np.abs(pushed.run.q - still.run.q[: len(pushed.run.q)]).max() > 0.01
    assert_no_limit_broken(pushed)
    assert np.abs(pushed.run.v[-1]).max() < 0.05


def test_torque_limits_hold_where_gravity_beats_the_motor():
    # Stretched out to the side, Baxter's shoulder cannot hold its arm: it sinks, within limits.
    values = load_values("baxter_left_arm")
    values["start_positions"] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    values["torque_max"] = [50.0, 40.0, 50.0, 50.0, 15.0, 15.0, 15.0]
    result = run_chain(values, {"duration": 1.0, "events": []}, {})
    assert result.vector("torque_ratio").max() <= 1.0 + 1e-9
    assert result.run.v[-1, 1] > 0.05, "it should sink"
    assert np.isfinite(result.run.tau).all()


def test_a_file_without_parameters_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(chain, "ROOT", tmp_path)
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "arm.yaml").write_text("")
    with pytest.raises(YamlError, match="no parameters"):
        chain.load_node_values("arm")
