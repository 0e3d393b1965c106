# SPDX-License-Identifier: Apache-2.0
"""Scenarios, played by the nodes in lockstep: events at their times, and what is refused."""

import numpy as np
import pinocchio as pin
import pytest
import yaml
from chain import load_values, run_chain
from direct import DirectLoop, column

from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.node.scenario_messages import to_controller
from sim_bridge.node.scenario_node import ScenarioRefused
from sim_bridge.scenario.events import TrajectoryGoal, read_trajectory
from sim_bridge.scenario.scenario import Scenario
from torque_safety_controller.driving.trajectory import TrajectoryMotion
from torque_safety_controller.node.goal_messages import trajectory_from_message
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, circle
from viability_bounds_pkg.testing.ros_harness import config_folder

ROBOT = "panda"
DURATION = 0.9
GAIN = 200.0  # 1/s^2
PLANE = [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]  # from the lowest point towards y
BEGIN, DIAMETER, PERIOD = 0.1, 0.1, 0.7  # of the circle, s, m
PUSHES = {"panda_link4": (0.2, 0.4, (0.0, 20.0, 0.0)), "panda_link6": (0.3, 0.5, (0.0, 0.0, 9.0))}
"""From, to, s, and force, N: they overlap."""
SIZE, OFFSET = np.array([0.3, 0.02, 0.3]), np.array([0.0, 0.16, 0.0])
"""Of a box in the way of the hand, m."""
GONE = 0.3  # s; while it is touched


def events(pose):
    orientation = pin.Quaternion(pose.rotation).coeffs()
    round_trip = {
        "start": pose.translation.tolist(),
        "diameter": DIAMETER,
        "plane": ["y", "z"],
        "phase": -0.5 * np.pi,
        "period": PERIOD,
        "orientation": (orientation / np.linalg.norm(orientation)).tolist(),
    }
    box = {"name": "box", "shape": "box", "size": SIZE.tolist()}
    box["position"] = (pose.translation + OFFSET).tolist()
    yield {"time": BEGIN, "trajectory": {"circle": round_trip}}
    yield {"time": 0.15, "obstacle": box}
    for link, (begin, end, force) in PUSHES.items():
        push = {"link": link, "duration": end - begin, "force": list(force)}
        yield {"time": begin, "push": push}
    change = {"node": "controller_node", "values": {"pose_kp": GAIN}}
    yield {"time": 0.25, "parameters": change}
    yield {"time": GONE, "remove_obstacle": {"name": "box"}}


def play_directly():
    """Return the samples of a loop without messages, and how often the box was touched."""
    loop = DirectLoop(ROBOT)
    start = loop.pose()
    trajectory = PoseTrajectory(circle(start, 0.5 * DIAMETER, PLANE, period=PERIOD))
    motion = TrajectoryMotion(trajectory, 0, loop.dt)
    touched = []

    def before(t):
        k = round(t / loop.dt)
        due = {round(time / loop.dt): time for time in (0.15, 0.25, GONE)}.get(k)
        if due == 0.15:
            position = start.translation + OFFSET
            loop.robot.obstacles.add(Obstacle("box", "box", SIZE, position))
        elif due == 0.25:
            loop.change(pose_kp=GAIN)
        elif due == GONE:
            loop.robot.obstacles.remove("box")
        for link, (begin, end, force) in PUSHES.items():
            on = round(begin / loop.dt) <= k < round(end / loop.dt)
            loop.robot.apply_wrench(link, force if on else np.zeros(3), np.zeros(3))
        if k >= round(BEGIN / loop.dt):
            motion.advance(loop.controller, loop.robot.state(), round(1e9 * t))
        touched.append(len(loop.robot.obstacles.contacts()) > 0)

    return loop.run(DURATION, before), np.array(touched), start


def test_the_nodes_play_what_a_loop_without_messages_plays():
    samples, touched, start = play_directly()
    scenario = {"duration": DURATION, "events": list(events(start))}
    runs = [run_chain(load_values(ROBOT), scenario, {}).run for _ in range(2)]
    for name in ("t", "q", "v", "tau", "ft_wrench"):
        np.testing.assert_array_equal(*(getattr(run, name) for run in runs))
    # Rounding; a push or a gain one step early or late makes a hundred times as much and more.
    np.testing.assert_allclose(runs[0].q, column(samples, "q"), atol=1e-6)
    assert touched.sum() > 20


@pytest.mark.long
def test_a_hand_presses_on_a_table_as_hard_as_it_is_told():
    """The beginning of the scenario that is shipped: a table, tare, a wrench."""
    name, folder = "panda_press_on_table.yaml", config_folder() / "scenarios"
    scenario = yaml.safe_load((folder / name).read_text())
    (own,) = yaml.safe_load((folder / "start" / name).read_text()).values()
    scenario = {
        "duration": 2.5,
        "events": [event for event in scenario["events"] if event["time"] < 2.5],
    }
    result = run_chain(load_values(ROBOT) | own["ros__parameters"], scenario, {})
    run = result.run
    tared, pressing = run.t < 0.5, run.t > 2.2
    force = run.ft_wrench[:, :3] - run.ft_wrench[tared, :3].mean(axis=0)
    assert abs(force[tared]).max() < 1.0  # noise
    np.testing.assert_allclose(force[pressing].mean(axis=0), [0.0, 0.0, -10.0], atol=0.5)
    assert float(result.robot["contact_force_max_n"]) < 13.0


def test_the_controller_follows_the_points_that_the_scenario_means():
    """In its own frames; a circle is in the test above."""
    rng = np.random.default_rng(0)
    base = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    points = []
    for k in range(4):
        turn = pin.Quaternion(pin.exp3(rng.normal(size=3))).coeffs()
        entry = {"time": 0.5 + k, "orientation": turn.tolist()}
        entry |= {key: rng.normal(size=3).tolist() for key in ("position", "velocity")}
        points.append(entry | {"acceleration": rng.normal(size=3).tolist()})
    meant = read_trajectory({"points": points}, "")
    plan = Scenario(9.0, (TrajectoryGoal(0.0, meant),))
    (message,) = to_controller(plan, "base", "hand")
    followed = trajectory_from_message(message.content, "base", "hand", base)
    for t in np.linspace(0.0, meant.duration + 0.5, 41):
        pose = base.actInv(followed.sample(t)[0])
        assert np.abs(pin.log6(pose.actInv(meant.sample(t)[0])).vector).max() < 1e-7


def rest():
    values = load_values(ROBOT)
    return dict(zip(values["joints"], values["start_positions"], strict=True))


def test_more_than_a_queue_holds_is_sent_in_portions():
    """A reader keeps ten messages of a topic until it gets round to them."""
    push = {"link": "panda_link4", "duration": 0.002, "force": [0.0, 1.0, 0.0]}
    scenario = {
        "duration": 0.1,
        "events": [
            *({"time": 0.004 * k, "posture": rest()} for k in range(12)),
            *({"time": 0.004 * k, "push": push} for k in range(6)),
        ],
    }
    result = run_chain(load_values(ROBOT), scenario, {})
    assert result.run.lost == 0
    assert result.robot["world_changes_pending"] == "0"


def test_torque_control_is_handed_over_and_back():
    scenario = {
        "duration": 0.4,
        "events": [
            {"time": 0.0, "posture": rest()},
            {"time": 0.1, "enable_torque": False},
            {"time": 0.3, "enable_torque": True},
        ],
    }
    result = run_chain(load_values(ROBOT), scenario, {})
    run = result.run
    by_drives = np.isnan(run.tau).any(axis=1)
    assert not by_drives[run.t < 0.099].any()
    assert by_drives[(run.t > 0.101) & (run.t < 0.299)].all()
    assert not by_drives[run.t > 0.325].any()  # ten samples of the motors' torque later
    assert run.lost == 0
    assert result.vector("torque_ratio").max() <= 1.0 + 1e-9


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (
            {"parameters": {"node": "controller_node", "values": {"pose_kp": -1.0}}},
            "at 0.1 s: controller_node/set_parameters .*pose_kp",
        ),
        (
            {"posture": rest() | {"panda_joint4": 0.5}},
            "refused by controller_node: target_posture: 1",
        ),
    ],
)
def test_what_is_refused_ends_the_scenario_and_says_why(event, words):
    scenario = {"duration": 0.3, "events": [{"time": 0.1} | event]}
    with pytest.raises(ScenarioRefused, match=words):
        run_chain(load_values(ROBOT), scenario, {})


def test_a_push_lasts_as_long_as_it_is_meant_to():
    """Longer than the robot holds a push that it hears no more of; and no longer."""
    begin, end = 0.1, 0.4  # s
    push = {"link": "panda_link5", "duration": end - begin, "force": [0.0, 3.0, 0.0]}
    events = [{"time": begin, "push": push}, {"time": 0.0, "posture": rest()}]
    short = {"bullet_node": {"external_wrench_timeout": 0.1}}
    result = run_chain(load_values(ROBOT), {"duration": 0.6, "events": events}, short)
    t, dt = result.run.t, np.diff(result.run.t)[0]
    # The accelerations jump where the push begins and where it ends.
    jumps = np.abs(np.diff(result.run.v, 2, axis=0)).max(axis=1)
    assert sorted(t[1:-1][np.argsort(jumps)[-2:]]) == pytest.approx([begin, end], abs=0.5 * dt)
    # The end of a push is nothing that the robot would refuse.
    assert "external_wrench" not in result.robot["commands_refused"]
