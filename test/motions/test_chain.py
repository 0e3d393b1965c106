# SPDX-License-Identifier: Apache-2.0
"""Bounds, controller and robot node together, over real DDS, in lockstep."""

import numpy as np
import pinocchio as pin
import pytest
import yaml
from chain import load_values, run_chain

from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import config_folder


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


@pytest.mark.parametrize(("robot", "rate"), [("baxter_left_arm", 100.0), ("panda", 1000.0)])
def test_random_goals_never_break_a_limit(robot, rate):
    rng = np.random.default_rng(0)
    values = load_values(robot) | {"rate_hz": rate, "pose_kp": 100.0}  # each joint is to hurry
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    start = 0.5 * (low + high) + 0.2 * (high - low) * rng.uniform(-1.0, 1.0, len(low))
    values["start_positions"] = start.tolist()
    events = list(pose_events(values, rng, (0.0, 0.8)))
    result = run_chain(values, {"duration": 1.6, "events": events}, {})
    assert_no_limit_broken(result)
    speeds = np.abs(result.run.v) / values["velocity_max"]
    assert speeds.max() > 0.9, "the arm was hardly driven"
    assert result.run.lost <= 1  # the last state, which nobody answers any more


@pytest.mark.parametrize(("robot", "goal"), [("baxter_left_arm", True), ("panda", False)])
def test_an_arm_outside_its_limits_moves_back_in(robot, goal):
    values = load_values(robot)
    inside = dict(zip(values["joints"], values["start_positions"], strict=True))
    values["start_positions"][4] = values["position_max"][4] + 0.05
    values["start_positions"][6] = values["position_min"][6] - 0.03
    events = [{"time": 0.0, "posture": inside}] if goal else []
    result = run_chain(values, {"duration": 1.5, "events": events}, {})
    # The first state has it outside, no later one further.
    outside = result.vector("position_violation_rad")
    assert outside[[4, 6]] == pytest.approx([0.05, 0.03], abs=1e-4)
    q = result.run.q
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


def test_torque_limits_hold_where_gravity_beats_the_motor():
    # Stretched out to the side, Baxter's shoulder cannot hold its arm: it sinks, within limits.
    values = load_values("baxter_left_arm")
    values["start_positions"] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    values["torque_max"] = [50.0, 40.0, 50.0, 50.0, 15.0, 15.0, 15.0]
    result = run_chain(values, {"duration": 1.0, "events": []}, {})
    assert result.vector("torque_ratio").max() <= 1.0 + 1e-9
    assert result.run.v[-1, 1] > 0.05, "it should sink"
    assert np.isfinite(result.run.tau).all()
