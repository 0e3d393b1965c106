# SPDX-License-Identifier: Apache-2.0
"""What all nodes of this project have in common besides what rclpy gives them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, ParameterNotDeclaredException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.claim import Claim
from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.ros_arguments import RosArgumentError
from viability_bounds_pkg.ros.topics import Topic

RCLError = rclpy_implementation.RCLError

CLOCK_TIMEOUT = 5.0
"""How long ``/clock`` may be silent at start before a node warns, s."""

_TYPE_PERIOD = 2.0  # s

_TOPICS_OF_ROS = ("/rosout", "/parameter_events", "/clock")


class ArmNode(Node):
    """A node that starts as a whole or not at all, and alone publishes what an arm obeys.

    Args:
        direct_delivery: to the other nodes of the process; None sends them messages, too, by the
            middleware alone.

    Attributes:
        NAME: of the node, unless it is remapped.
        PARAMETERS: the dataclass of its parameters.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[type]

    def __init__(
        self, *, direct_delivery: DirectDelivery | None = None, **node_arguments: Any
    ) -> None:
        self.direct_delivery = direct_delivery
        self._claims: list[Claim] = []
        self._told_of_clock = False
        try:
            # With the services that `rqt_logger_level` uses.
            super().__init__(self.NAME, enable_logger_service=True, **node_arguments)
        except InvalidParameterTypeException as error:  # of use_sim_time: rclpy declares it
            raise RosArgumentError(str(error).rpartition(": ")[0]) from error
        except RCLError as error:  # of the middleware, such as security that it does not have
            raise RosArgumentError(" ".join(str(error).split(", at /")[0].split())) from error
        self._guard()

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    def _guard(self) -> None:
        """Refuse what ends a node inside of rclpy: times before 0, parameters of no type."""
        source = self._time_source  # subscribes now, or when use_sim_time becomes true
        take = source.clock_callback
        source.clock_callback = partial(self._on_clock, take)
        for subscription in self.subscriptions:
            if subscription.callback == take:
                subscription.callback = source.clock_callback
        for service in self.services:
            if service.srv_type in (SetParameters, SetParametersAtomically):
                service.callback = partial(self._on_set_parameters, service.callback)

    def _on_clock(self, take: Callable[[Any], None], message: Any) -> None:
        if message.clock.sec >= 0:
            take(message)
        elif not self._told_of_clock:
            self._told_of_clock = True
            self._warn(f"/clock refused: {message.clock.sec} s, before 0")

    def _on_set_parameters(self, take: Callable[..., Any], request: Any, response: Any) -> Any:
        types = {kind.value for kind in Parameter.Type}
        strange = [each for each in request.parameters if each.value.type not in types]
        if not strange:
            if not self._set_together(request, response):
                take(request, response)
            return response
        refused = SetParametersResult(
            reason=f"parameter '{strange[0].name}' has a type of number {strange[0].value.type}; "
            f"allowed: 0 to {max(types)}"
        )
        if isinstance(response, SetParametersAtomically.Response):
            response.result = refused
        else:
            response.results = [refused] * len(request.parameters)
        return response

    def _set_together(self, request: Any, response: Any) -> bool:
        """Set several parameters at once where that is allowed, as of a file; else set none.

        One by one each is judged with what was there before it, which keeps a control loop waiting
        for longer, and may refuse what fits only together.
        """
        if not isinstance(response, SetParameters.Response) or len(request.parameters) < 2:
            return False
        parameters = [Parameter.from_parameter_msg(each) for each in request.parameters]
        if len({each.name for each in parameters}) < len(parameters):
            return False  # the last of one name counts
        try:
            result = self.set_parameters_atomically(parameters)
        except ParameterNotDeclaredException:
            return False
        response.results = [result] * len(parameters) if result.successful else []
        return bool(result.successful)

    @contextmanager
    def starting(self, *topics: Topic) -> Iterator[None]:
        """Claim topics, and take the node down again if what is done meanwhile is refused.

        Raises:
            TakenError: another node publishes one of the topics.
        """
        try:
            for topic in topics:
                self.claim("publishes", self.resolve_topic_name(topic.name))
            yield
        except ArmSafetyError:
            self.destroy_node()
            raise

    def claim(self, does: str, name: str) -> None:
        """Let no second node on this host do something while this one exists, see `Claim`."""
        self._claims.append(Claim(self, does, name))

    def announce(self, joints: Sequence[str], rate: float, what: str) -> None:
        """Log in one line what the node does, for which joints, and the topics that it uses.

        Args:
            joints: their names.
            rate: of the control loop, Hz.
            what: modes and methods, in words.
        """
        published, heard = map(" ".join, self.topics_used())
        # A parameter of the scenario node, which robots' files have for all nodes.
        name = self._parameter_overrides.get("robot_name")
        self.get_logger().info(
            f"{name.value if name else 'robot'}, {len(joints)} joints ({joints[0]} to "
            f"{joints[-1]}) at {rate:g} Hz, {what}; subscribes to {heard}; publishes {published}"
        )
        if self.get_parameter("use_sim_time").value:
            self._expect_clock()
        self._watch_types(self.get_name(), self.get_namespace())

    def topics_used(self) -> tuple[list[str], list[str]]:
        """Return the names of the topics that the node publishes, and of those subscribed to."""
        here = self.get_name(), self.get_namespace()
        published, heard = (
            sorted(name for name, _ in topics if name not in _TOPICS_OF_ROS)
            for topics in (
                self.get_publisher_names_and_types_by_node(*here),
                self.get_subscriber_names_and_types_by_node(*here),
            )
        )
        return published, heard

    def _expect_clock(self) -> None:
        """Warn once if nothing publishes ``/clock``: stamps of what is published stay zero."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)

        def look() -> None:
            timer.cancel()
            if not self.count_publishers("/clock"):
                self.get_logger().warning(
                    f"use_sim_time is true, but nothing has published /clock for {CLOCK_TIMEOUT:g}"
                    " s: set it to false, or start the simulation that publishes it"
                )

        timer = self.create_timer(CLOCK_TIMEOUT, look, clock=steady)

    def _watch_types(self, name: str, namespace: str) -> None:
        """Warn of topics that others use with another type: the middleware keeps them apart."""
        own = {
            topic: types[0]
            for topics in (
                self.get_publisher_names_and_types_by_node(name, namespace),
                self.get_subscriber_names_and_types_by_node(name, namespace),
            )
            for topic, types in topics
        }

        def look() -> None:
            for topic, types in self.get_topic_names_and_types():
                others = [each for each in types if each != own.get(topic, each)]
                if others:
                    kind = own.pop(topic)
                    self.get_logger().warning(
                        f"'{topic}' is {kind} here; what is {' or '.join(others)} elsewhere is "
                        "not received"
                    )

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TYPE_PERIOD, look, clock=steady)

    def destroy_node(self) -> None:
        """Give up the claims, too."""
        for claim in self._claims:
            claim.close()
        if self.direct_delivery is not None:
            self.direct_delivery.leave(self)
        super().destroy_node()
