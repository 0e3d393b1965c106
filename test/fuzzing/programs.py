# SPDX-License-Identifier: Apache-2.0
"""Programs started with odd files: refused in one line, or they keep the claims for some steps."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from fuzzing.tally import ClaimBroken
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.nodes import bullet_node, fault_node, scenario_node, simulated_stack
from torque_safety_controller.node import controller_node, safety_stack
from torque_safety_controller.tools import gain_limits
from viability_bounds_pkg.cli import estimate_acceleration_limits
from viability_bounds_pkg.node import bounds_node, estimator_node
from viability_bounds_pkg.ros import program
from viability_bounds_pkg.ros.claim import Claim
from viability_bounds_pkg.ros.topics import ACCELERATION_LIMITS, JOINT_COMMANDS
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state
from viability_bounds_pkg.tools import uncertainty_cost
from viability_bounds_pkg.user_input.known_names import parameter_names

_URDF = import_module("viability_bounds_pkg.ros.robot_urdf")  # the function has its name, too

PERIODS = 40
"""How many control periods an accepted file must stand."""
CPU_MAX = 30.0
"""Longer no start may compute, s of the processor."""
_REAL_MAX = 5.0
_STEP = 2_000_000
_LOG = re.compile(r"\[(DEBUG|INFO|WARN|ERROR|FATAL)\] \[")

NODES: dict[str, Callable[..., int]] = {
    "bounds_node": bounds_node.main,
    "controller_node": controller_node.main,
    "estimator_node": estimator_node.main,
    "bullet_node": bullet_node.main,
    "safety_stack": safety_stack.main,
    "simulated_stack": simulated_stack.main,
}
"""Programs that read a robot's file."""
TOOLS: dict[str, Callable[..., int]] = {
    "estimate_acceleration_limits": estimate_acceleration_limits.main,
    "gain_limits": gain_limits.main,
    "uncertainty_cost": uncertainty_cost.main,
}


class TooSlow(Exception):
    """A program computes too long at its start."""


class Ended(NamedTuple):
    """How a program ended.

    Attributes:
        code: its exit code.
        lines: what it wrote to stderr, without its log.
        periods: how many commands it made, if it started.
    """

    code: int
    lines: list[str]
    periods: int


def started(name: str, arguments: Sequence[str], end: Callable[[Any, Any], int]) -> Ended:
    """Start a program in this process; `end` is called where it would run until it is told to end.

    Raises:
        TooSlow: it computes too long.
        Exception: what the program should have caught.
    """
    main = (NODES | TOOLS | _OTHERS)[name]
    words = list(arguments) if name in TOOLS else [name, *arguments]
    used: list[int] = []

    def use(executor: Any, node: Any) -> None:
        used.append(end(executor, node))

    with _captured() as lines, _limited(), _replaced(use):
        try:
            code: Any = main(words)
        except SystemExit as ended:
            code = ended.code
        except Exception:
            for each in gc.get_objects():
                if isinstance(each, Claim):
                    each.close()  # of nodes that the error has left
            raise
        finally:
            rclpy.try_shutdown()
    return Ended(int(code or 0), lines, sum(used))


def check_refusal(ended: Ended, names: frozenset[str], paths: Sequence[str]) -> None:
    """Check that a refusal is one line that names a parameter or the place in a file."""
    if len(ended.lines) != 1:
        raise ClaimBroken(f"a refusal of {len(ended.lines)} lines: {ended.lines}")
    (line,) = ended.lines
    known = re.findall(r"'([\w./\[\]]+)'", line)
    said = (
        any(path in line for path in paths)
        or any(name in line for name in names)
        or re.search(r"\bjoint '?\w", line) is not None
        or any(re.split(r"[\[.]", each)[0] in parameter_names() for each in known)
    )
    if not said or "Traceback" in line:
        raise ClaimBroken(f"a refusal that names no parameter, nor the file: {line}")


@contextlib.contextmanager
def _captured() -> Iterator[list[str]]:
    """Yield what is written to stderr, of C as well, when it is over."""
    lines: list[str] = []
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile("w+") as file, open(os.devnull, "w") as nothing:
        os.dup2(file.fileno(), 2)
        try:
            with contextlib.redirect_stderr(file), contextlib.redirect_stdout(nothing):
                yield lines
        finally:
            file.flush()
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            lines += [
                line for line in file.read().splitlines() if line.strip() and not is_log(line)
            ]


def is_log(line: str) -> bool:
    """Return whether a line is one of the log."""
    return _LOG.match(line) is not None


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Raise `TooSlow` after too much time of the processor; keep what handles signals."""

    def late(number: int, _: object) -> None:
        raise TooSlow(f"computes for more than {CPU_MAX:g} s")

    kept = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, CPU_MAX)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        for number, handler in kept.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _replaced(use: Callable[[Any, Any], None]) -> Iterator[None]:
    """Have programs do `use` where they would run."""
    spin, play, wait = program.spin, scenario_node.play, _URDF._TOPIC_TIMEOUT
    program.spin = use
    scenario_node.play = lambda node, *_, **__: use(None, node)
    _URDF._TOPIC_TIMEOUT = 0.1
    try:
        yield
    finally:
        program.spin, scenario_node.play, _URDF._TOPIC_TIMEOUT = spin, play, wait


_OTHERS: dict[str, Callable[..., int]] = {
    "scenario_node": scenario_node.main,
    "fault_node": fault_node.main,
}


# What an accepted file must stand


def use(executor: Any, node: Any) -> int:
    """Use a node that has started; return how many commands or answers were checked."""
    if isinstance(node, bullet_node.BulletNode) and node.direct_delivery is not None:
        return _use_stack(executor, node)
    if isinstance(node, controller_node.ControllerNode):
        return _use_controller(node)
    if isinstance(node, bounds_node.BoundsNode):
        return _use_bounds(node)
    if isinstance(node, estimator_node.EstimatorNode):
        return _use_estimator(node)
    if isinstance(node, bullet_node.BulletNode):
        return _use_robot(node)
    if isinstance(node, fault_node.FaultNode):
        return _use_faults(node)
    node._report() if hasattr(node, "_report") else node._proceed()
    return 1


def _use_stack(executor: Any, robot: bullet_node.BulletNode) -> int:
    """Let all nodes run in lockstep; check limits and commands."""
    checked: Counter[str] = Counter()
    tau_max = robot._config.torque_max

    def command(message: JointState) -> None:
        checked["commands"] += 1
        _check_torque(np.array(message.effort), tau_max)

    def limits(message: JointTrajectory) -> None:
        _check_limits(*(np.array(point.accelerations) for point in message.points))

    for topic, look in ((JOINT_COMMANDS, command), (ACCELERATION_LIMITS, limits)):
        topic.subscription(robot, look)
    deadline = time.monotonic() + _REAL_MAX
    while checked["commands"] < PERIODS and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.02)
    return checked["commands"]


def _check_torque(tau: np.ndarray, tau_max: np.ndarray) -> None:
    if not np.isfinite(tau).all():
        raise ClaimBroken(f"a torque is not finite: {tau}")
    if len(tau) and (np.abs(tau) > tau_max * (1.0 + 1e-9)).any():
        raise ClaimBroken(f"a torque beyond torque_max: {tau}, {tau_max}")


def _check_limits(lower: np.ndarray, upper: np.ndarray) -> None:
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise ClaimBroken(f"acceleration limits are not finite: {lower}, {upper}")
    if not (lower <= upper).all():
        raise ClaimBroken(f"lower above upper: {lower}, {upper}")


def _states(config: Any) -> Iterator[tuple[int, JointState]]:
    """Yield states of an arm that stands, and then moves slowly."""
    low, high = np.array(config.position_min), np.array(config.position_max)
    q = np.clip(
        np.zeros(len(low)), np.nan_to_num(low, neginf=-1.0), np.nan_to_num(high, posinf=1.0)
    )
    for k in range(1, PERIODS + 1):
        v = np.full(len(low), 0.01 * (k > PERIODS // 2))
        q = q + 1e-9 * _STEP * v
        yield k * _STEP, joint_state(config.joints, k * _STEP, q, v, np.zeros(len(low)))


def _use_controller(node: controller_node.ControllerNode) -> int:
    config = node._config
    answered = 0
    a = np.full(len(config.joints), 1.0)
    for stamp, state in _states(config):
        node._on_state(state)
        node._on_limits(acceleration_limits(config.joints, stamp, -a, a))
        if node._states.answered_stamp == stamp:
            answered += 1
            _check_torque(np.array(node._commands._torques.effort), config.torque_max)
    node._watch()
    node._diagnostics.publish()
    return answered


def _use_bounds(node: bounds_node.BoundsNode) -> int:
    for _, state in _states(node._node_parameters.configuration):
        node._on_state(state)
        _check_limits(*(np.array(point.accelerations) for point in node._answer.points))
    node._diagnostics.publish()
    return PERIODS


def _use_estimator(node: estimator_node.EstimatorNode) -> int:
    for stamp, state in _states(node._config):
        node._on_state(state)
        if node._answer.position and not np.isfinite(node._answer.position).all():
            raise ClaimBroken(f"an estimated state is not finite: {node._answer}")
        tau = np.zeros(len(node._config.joints))
        node._on_command(joint_state(node._config.joints, stamp, tau=tau))
    node._diagnostics.publish()
    return PERIODS


def _use_robot(node: bullet_node.BulletNode) -> int:
    """Send torques of every size."""
    n = len(node._config.joints)
    for k in range(PERIODS):
        tau = [(-1.0) ** k * 10.0 ** (k - PERIODS // 2)] * n
        node._on_command(joint_state(node._config.joints, node._stamp, tau=tau))
        if not node._config.lockstep:
            node._tick()
        ratio = node._monitor.max_torque_ratio
        if np.isfinite(ratio).all() and (ratio > 1.0 + 1e-9).any():
            raise ClaimBroken(f"torques of the motors are {ratio} of torque_max")
    node._diagnostics.publish()
    return PERIODS


def _use_faults(node: fault_node.FaultNode) -> int:
    """Pass streams for some seconds of robot time."""
    joints = [f"panda_joint{k}" for k in range(1, 8)]
    for k in range(10 * PERIODS):
        stamp = 25_000_000 * k
        for name in node.streams:
            message: Any = fault_node.STREAMS[name].message()
            if isinstance(message, JointState):
                message = joint_state(joints, stamp, [0.1] * 7, [0.2] * 7, [0.3] * 7)
            elif isinstance(message, JointTrajectory):
                message = acceleration_limits(joints, stamp, [-1.0] * 7, [1.0] * 7)
            node._on_message(name, message)
    node._send_due()
    node._diagnostics.publish()
    return 10 * PERIODS


def write(data: bytes, folder: Path, name: str) -> Path:
    """Write a file and return its path."""
    path = folder / f"{name}.yaml"
    path.write_bytes(data)
    return path
