# SPDX-License-Identifier: Apache-2.0
"""Robot, estimator, bounds and controller in one process."""

import os
import signal
import subprocess
from contextlib import contextmanager
from pathlib import Path

import chain
import numpy as np
import pytest
import yaml
from chain import NODES, load_node_values, load_values, run_chain
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.node import simulated_stack
from torque_safety_controller.node import safety_stack
from viability_bounds_pkg.ros.runtime import CONTROL_QOS
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import joint_state, private_domain

ROOT = Path(__file__).resolve().parents[2]
DEADLINE = 300.0  # s
SAFETY = ("torque_safety_controller", "safety_stack")
SIMULATED = ("sim_bridge", "simulated_stack")


@pytest.fixture
def own_domain(monkeypatch):
    """A program that was killed stays in the graph of its domain for some seconds."""
    with private_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield


@pytest.mark.usefixtures("own_domain")
@pytest.mark.parametrize(
    ("robot", "overlays", "left_out"),
    [
        ("panda", (), {"estimator_node"}),
        ("talos_left_arm", ("imperfect/talos_left_arm",), set()),
    ],
)
def test_in_lockstep_all_numbers_are_those_of_messages(monkeypatch, robot, overlays, left_out):
    """Force sensor and estimator included: bit for bit what the middleware gives."""
    values = load_values(robot)
    per_node = load_node_values(robot, *overlays)
    per_node = {name: own for name, own in per_node.items() if name not in left_out}
    push = {"link": values["end_effector_frame"], "duration": 0.1, "force": [0.0, 10.0, 0.0]}
    demo = yaml.safe_load((ROOT / "config" / "scenarios" / f"{robot}_demo.yaml").read_text())
    events = [*demo["events"][:1], {"time": 0.2, "push": push}]
    scenario = {"duration": 0.4, "events": events}
    run = run_chain(values, scenario, per_node).run
    monkeypatch.setattr(chain, "connect", lambda nodes: None)
    apart = run_chain(values, scenario, per_node).run
    assert np.ptp(run.q, axis=0).max() > 0.02, "it moves"
    for name in ("t", "q", "v", "a_lower", "a_upper", "tau", "ft_wrench"):
        np.testing.assert_array_equal(getattr(run, name), getattr(apart, name), name)


@contextmanager
def running(ros, stack, *arguments):
    """Run a program with the parameters of Panda, end it by SIGTERM: without an error."""
    package, name = stack
    config = ROOT / "config" / "panda.yaml"
    process = subprocess.Popen(
        [ROOT / "install" / package / "lib" / package / name, "--ros-args", "--log-level", "warn"]
        + ["--params-file", config, *map(str, arguments)],
        env=os.environ | {"ROS_DOMAIN_ID": str(ros.domain)},
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    )
    try:
        yield process
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=DEADLINE)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert not {word for word in ("Traceback", "Error", "changes no topic") if word in errors}


def test_each_node_keeps_name_parameters_and_topics(ros):
    """A namespace, a remapped topic, parameters of one node: as with programs for each."""
    imperfect = ROOT / "config" / "imperfect" / "panda.yaml"
    options = ["-p", "clock:=lockstep", "-p", "bounds_node:method:=decre"]
    options += ["-p", "controller_node:safety_filter:=false"]
    options += ["-r", "__ns:=/left", "-r", "joint_commands:=torques"]
    with running(ros, SIMULATED, "--params-file", imperfect, *options):
        names = {f"left/{kind.NAME}" for kind in NODES.values()} - {"left/scenario_node"}
        ros.wait_until(lambda: names <= set(ros.diagnostics), "diagnostics", timeout=DEADLINE)
        assert ros.reported("left/bounds_node", "method") == "decre"
        ros.accepts("/left/controller_node", posture_kp=34.0)
        topics = {
            "joint_states": JointState,
            "estimated_joint_states": JointState,
            "acceleration_limits": JointTrajectory,
            "torques": JointState,
        }
        heard = [ros.listen(kind, f"/left/{name}") for name, kind in topics.items()]
        ros.wait_until(
            lambda: set.intersection(*(set(each.stamps) for each in heard)),
            "a state with all that follows from it",
        )
        # Within the process messages take no way through ROS.
        readers = ros.probe.get_subscriptions_info_by_topic("/left/torques")
        assert {each.node_name for each in readers} == {"probe"}


def test_a_robot_elsewhere_is_answered(ros):
    """No estimator runs where none is needed."""
    values = load_values("panda")
    n = len(values["joints"])
    stamps = iter(range(1, 10_000))
    with running(ros, SAFETY):
        commands = ros.listen(JointState, "joint_commands")
        robot = ros.probe.create_publisher(JointState, "joint_states", CONTROL_QOS)

        def send():
            stamp = next(stamps) * 2_000_000
            robot.publish(
                joint_state(values["joints"], stamp, values["start_positions"], [0.0] * n)
            )

        ros.wait_until(lambda: len(commands) > 3, timeout=DEADLINE, each=send)
        assert len(set(commands.stamps)) == len(commands), "each state is answered once"
        ros.wait_until(lambda: {"bounds_node", "controller_node"} <= set(ros.diagnostics))
        assert "estimator_node" not in ros.probe.get_node_names()


@pytest.mark.parametrize("stack", [safety_stack, simulated_stack])
def test_a_node_that_cannot_start_ends_all_with_one_line(capfd, stack):
    arguments = [stack.__name__, "--ros-args", "--params-file", str(ROOT / "config/panda.yaml")]
    assert stack.main([*arguments, "-p", "controller_node:pose_kp:=-1.0"]) == 1
    errors = [line for line in capfd.readouterr().err.splitlines() if "error" in line]
    assert errors == ["error: parameter 'pose_kp' is -1; allowed: a number >= 0 and <= 100000"]
