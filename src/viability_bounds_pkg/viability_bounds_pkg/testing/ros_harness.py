# SPDX-License-Identifier: Apache-2.0
"""Nodes under test: the real ones and a probe, over real DDS, in one process and one executor.

Each `RosHarness` has a context of its own in a domain that nothing else on this machine uses,
so that tests may run at the same time as each other and as a robot. What a test waits for it
waits for with `wait_until`, which runs callbacks until a condition holds or a deadline passes;
nothing sleeps.
"""

from __future__ import annotations

import functools
import itertools
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import pytest
import rclpy
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter_files import read_yaml
from viability_bounds_pkg.ros.runtime import (
    CONTROL_QOS,
    make_executor,
    set_stamp,
    settle_dds,
    stamp_to_ns,
)


def config_folder() -> Path:
    """Return the folder of the robots' parameter files: this repository's, or the installed."""
    here = Path(__file__).resolve().parents[3] / "sim_bridge" / "config"
    if here.is_dir():
        return here
    return Path(get_package_share_directory("sim_bridge")) / "config"


TIMEOUT = 120.0
"""How long anything may take before a test fails, s; far more than it takes."""

RECORDING_QOS = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Loses nothing that comes while other callbacks run."""

# On Linux these domains use no port that the system hands out by itself.
_DOMAINS = (*range(215, 232), *range(60, 101))
_LOCK_PORT = 17_400
_turns = itertools.count(os.getpid())


@contextmanager
def private_domain() -> Iterator[int]:
    """Hold a domain id that no other process uses, or holds through this function."""
    for _ in _DOMAINS:
        domain = _DOMAINS[next(_turns) % len(_DOMAINS)]
        with socket.socket() as lock, socket.socket(type=socket.SOCK_DGRAM) as port:
            # The second port is that of the first node of a domain.
            free = _binds(lock, "127.0.0.1", _LOCK_PORT + domain)
            free = free and _binds(port, "", 7410 + 250 * domain)
            port.close()
            if free:
                yield domain
                return
    raise RuntimeError("every domain is taken")


def _binds(opened: socket.socket, host: str, port: int) -> bool:
    try:
        opened.bind((host, port))
    except OSError:
        return False
    return True


_read_once = functools.cache(read_yaml)


def read_config(robot: str, *nodes: str) -> dict[str, Any]:
    """Return the parameters that ``config/<robot>.yaml`` has for nodes."""
    document = deepcopy(_read_once(config_folder() / f"{robot}.yaml"))
    sections = [document.get(key, {}) for key in ("/**", *(f"/**/{node}" for node in nodes))]
    return {k: v for section in sections for k, v in section.get("ros__parameters", {}).items()}


def overrides(values: Mapping[str, Any]) -> list[Parameter]:
    """Return values as rclpy takes them; None leaves a parameter out."""
    return [Parameter(key, value=value) for key, value in values.items() if value is not None]


class Heard(list):
    """Messages of one topic in the order they came."""

    @property
    def stamps(self) -> list[int]:
        """Of all messages, ns."""
        return [stamp_to_ns(message.header.stamp) for message in self]


def names_parameter(reason: str, name: str) -> bool:
    """Return whether a refusal names the parameter: rclpy's, of a range, or this project's."""
    return reason.startswith((f"parameter '{name}' is ", f"Parameter {name} out of range"))


class RosHarness:
    """A private context with nodes in it.

    Attributes:
        probe: a node to publish, listen and call services from.
        diagnostics: last values reported on ``/diagnostics``, by node and key, with the
            status' own under "level" and "message".
    """

    def __init__(self, domain: int) -> None:
        self.domain = domain
        settle_dds(os.environ)  # as the programs do
        self.context = rclpy.Context()
        rclpy.init(
            args=[],
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        # Of the whole process, so that it may be what another context wanted.
        set_logger_level("", LoggingSeverity.INFO)
        self.executor = make_executor(self.context)
        self._nodes: list[Node] = []
        self.probe = self.add(Node("probe", context=self.context, start_parameter_services=False))
        self.diagnostics: dict[str, dict[str, Any]] = {}
        self.probe.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def add(self, node: Node) -> Node:
        """Run `node` here from now on."""
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def start(self, make: Callable[..., Node], values: Mapping[str, Any]) -> Node:
        """Make a node with these parameters and run it."""
        return self.add(make(context=self.context, parameter_overrides=overrides(values)))

    def refuses_to_start(
        self, make: Callable[..., Node], values: Mapping[str, Any], name: str, shown: str = ""
    ) -> None:
        """Expect that a node does not start: one line names a parameter and contains `shown`."""
        with pytest.raises(
            SettingError, match=r"\Aparameter '.+' is .+; allowed: .+\Z"
        ) as refused:
            self.start(make, values)
        assert refused.value.name == name
        assert shown in str(refused.value)

    def stop(self, node: Node) -> None:
        """Take a node down before the test ends."""
        self._nodes.remove(node)
        self.executor.remove_node(node)
        # The events executor still holds what has come for the node.
        for _ in range(10):
            self.spin()
        node.destroy_node()

    def close(self) -> None:
        """Take everything down."""
        for node in reversed(self._nodes):
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown()
        rclpy.shutdown(context=self.context)

    # Running

    def spin(self, timeout: float = 0.0) -> None:
        """Run what is ready; wait up to `timeout` s for it."""
        self.executor.spin_once(timeout_sec=timeout)

    def wait_until(
        self,
        condition: Callable[[], Any],
        what: str = "",
        timeout: float = TIMEOUT,
        each: Callable[[], Any] | None = None,
        period: float = 0.02,
    ) -> Any:
        """Run callbacks until `condition` holds, and return what it returned.

        Args:
            condition: looked at after each callback.
            what: is awaited, for the message of the `AssertionError` when it does not come.
            timeout: after which it has not come, s.
            each: called every `period` s meanwhile: what a robot would send again.
            period: of `each`, s.
        """
        begin = called = time.monotonic()
        if each is not None:
            each()
        while not (result := condition()):
            now = time.monotonic()
            assert now - begin < timeout, f"not within {timeout} s: {what or condition}"
            if each is not None and now - called >= period:
                called = now
                each()
            self.spin(min(period, 0.02))
        return result

    def run_for(
        self,
        duration: float,
        each: Callable[[], Any] | None = None,
        period: float = 0.02,
    ) -> None:
        """Run callbacks for `duration` s: only to show that something does not happen."""
        end = time.monotonic() + duration
        self.wait_until(
            lambda: time.monotonic() >= end, timeout=duration + TIMEOUT, each=each, period=period
        )

    # Messages

    def listen(self, kind: Any, topic: str, qos: QoSProfile = RECORDING_QOS) -> Heard:
        """Return a list that grows by each message of a topic."""
        heard = Heard()
        self.probe.create_subscription(kind, topic, heard.append, qos)
        return heard

    def talk(self, kind: Any, topic: str, qos: QoSProfile = CONTROL_QOS) -> Any:
        """Return the probe's publisher of a topic, which has been found by subscribers."""
        name = self.probe.resolve_topic_name(topic)
        own = (each for each in self.probe.publishers if each.topic_name == name)
        publisher = next(own, None) or self.probe.create_publisher(kind, topic, qos)
        self.wait_until(publisher.get_subscription_count, f"a subscriber of {topic}")
        return publisher

    def hears(self, topic: str, publishers: int = 1) -> None:
        """Wait until publishers of a topic have been found."""
        self.wait_until(
            lambda: self.probe.count_publishers(topic) >= publishers, f"a publisher of {topic}"
        )

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service and return its response."""
        client = self.probe.create_client(kind, service)
        self.wait_until(client.service_is_ready, f"service {service}")
        future = client.call_async(request)
        self.wait_until(future.done, f"answer of {service}")
        self.probe.destroy_client(client)
        return future.result()

    def set_parameters(self, node: str, **values: Any) -> list[Any]:
        """Set parameters as ``ros2 param set`` does; return one result for each."""
        parameters = [Parameter(k, value=v).to_parameter_msg() for k, v in values.items()]
        request = SetParameters.Request(parameters=parameters)
        return self.call(SetParameters, f"{node}/set_parameters", request).results

    def refuses(self, node: str, **values: Any) -> str:
        """Set one parameter, expect a refusal and return its reason."""
        (result,) = self.set_parameters(node, **values)
        assert not result.successful, f"{values} was accepted"
        return result.reason

    def accepts(self, node: str, **values: Any) -> None:
        """Set parameters, expect that they are taken."""
        for result in self.set_parameters(node, **values):
            assert result.successful, result.reason

    def assert_limits_kept(self) -> None:
        """Check that the simulated robot has never been beyond a limit since its last reset."""
        self.diagnostics.clear()
        robot = self.wait_until(lambda: self.diagnostics.get("bullet_node"))
        for key in ("position_violation_rad", "velocity_violation_rad_s"):
            assert max(map(float, robot[key].split())) == 0.0, (key, robot[key])
        assert max(map(float, robot["torque_ratio"].split())) <= 1.0 + 1e-9, robot["torque_ratio"]

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            values |= {"level": status.level, "message": status.message}
            self.diagnostics[status.name] = values

    def reported(self, node: str, key: str) -> str:
        """Return a value of the last diagnostics of a node, or the empty string."""
        return self.diagnostics.get(node, {}).get(key, "")


def joint_state(joints, stamp: int, q=(), v=(), tau=()) -> JointState:
    """Return a message; `stamp` in ns."""
    message = JointState(
        name=list(joints),
        position=list(map(float, q)),
        velocity=list(map(float, v)),
        effort=list(map(float, tau)),
    )
    set_stamp(message.header.stamp, stamp)
    return message


def acceleration_limits(joints, stamp: int, lower, upper) -> JointTrajectory:
    """Return a message; `stamp` in ns."""
    message = JointTrajectory(
        joint_names=list(joints),
        points=[
            JointTrajectoryPoint(accelerations=list(map(float, bound))) for bound in (lower, upper)
        ],
    )
    set_stamp(message.header.stamp, stamp)
    return message
