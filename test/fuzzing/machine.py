# SPDX-License-Identifier: Apache-2.0
"""Random sequences of all that can go wrong, played on the real nodes; claims after each step."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from functools import cache
from typing import Any, ClassVar

from fuzzing.message_edits import FACTORS, NUMBERS, edits
from fuzzing.stack import GOALS, KINDS, STREAMS, TOPICS, VARIANTS, Stack, running
from fuzzing.tally import Tally
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import Parameter as RosParameter

from viability_bounds_pkg.parameter import Parameter, parameter_table

_BATCH = {"min_size": 24, "max_size": 80}
"""Odd messages in a step."""

_MESSAGE = st.tuples(
    st.sampled_from([*TOPICS, *STREAMS, *GOALS]),
    edits(),
    st.integers(0, 255),
    st.booleans(),
    st.integers(0, 19).map(lambda k: k == 19),  # one in twenty by DDS
)
_TUNED = ("bounds_node", "controller_node", "bullet_node")
_ODD_VALUES: tuple[Any, ...] = (
    *NUMBERS,
    True,
    0,
    -1,
    2**62,
    "",
    "nobody",
    [],
    [0.0],
    [float("nan")] * 7,
    ["a", "b"],
    None,
)


@cache
def _rows(node: str) -> tuple[Parameter, ...]:
    return parameter_table(KINDS[node].PARAMETERS)


@st.composite
def _parameter(draw: Any) -> tuple[str, ParameterMessage]:
    """Return a node and a parameter to set: odd, or far from what is usual, or fine."""
    node = draw(st.sampled_from(_TUNED))
    rows = _rows(node)
    live = [row for row in rows if row.live]
    row = draw(st.sampled_from(live if draw(st.integers(0, 4)) else rows))
    name = draw(st.sampled_from((row.name,) * 15 + ("", "nobody")))
    value = draw(_value_of(row))
    try:
        message = RosParameter(name, value=value).to_parameter_msg()
    except (TypeError, ValueError, AssertionError):  # no type of ROS
        message = ParameterMessage(name=name)
    if draw(st.integers(0, 30)) == 30:
        message.value = ParameterValue(type=draw(st.sampled_from((0, 4, 9, 99, 255))))
    return node, message


def _value_of(row: Parameter) -> st.SearchStrategy[Any]:
    usual: list[Any] = [] if row.default is None else [row.default]
    if row.choices:
        usual += row.choices
    if row.within is not None:
        ends = (row.within.low, row.within.high, row.within.special)
        usual += [end for end in ends if end is not None and abs(end) < float("inf")]
        usual += [0.5, 1.0, 10.0]
    if row.kind is bool:
        usual += [True, False]
    if row.kind == list[float]:
        count = row.length or 7
        usual += [[factor] * count for factor in (*FACTORS, 0.1, 1.0)]
    usual = [
        list(map(float, each)) if hasattr(each, "__len__") and row.kind == list[float] else each
        for each in usual
        if isinstance(each, str | bool | int | float) or hasattr(each, "__len__")
    ]
    if row.kind is int:
        usual = [int(each) for each in usual]
    return st.one_of(*([st.sampled_from(usual)] * bool(usual)), st.sampled_from(_ODD_VALUES))


class Machine(RuleBasedStateMachine):
    """Odd messages, good goals, parameters, nodes that go and come, time, rivals, pauses."""

    tally: ClassVar[Tally] = Tally()
    variants: ClassVar[tuple[str, ...]] = tuple(VARIANTS)

    def __init__(self) -> None:
        super().__init__()
        self._exit = ExitStack()
        self._restarts = self._recoveries = 0

    @initialize(data=st.data(), real_time=st.booleans())
    def begin(self, data: Any, real_time: bool) -> None:
        variant = data.draw(st.sampled_from(self.variants), "robot")
        self.stack: Stack = self._exit.enter_context(running(variant, real_time, self.tally))
        self.stack.run(3)
        self.stack.good_goal(0)

    def teardown(self) -> None:
        with self._exit:
            # After a failure the next error would hide it.
            if hasattr(self, "stack") and sys.exc_info()[0] is None:
                self.stack.recover()

    @invariant()
    def claims_hold(self) -> None:
        if hasattr(self, "stack"):
            self.stack.check()

    @rule(batch=st.lists(_MESSAGE, **_BATCH), periods=st.integers(0, 3))
    def odd_messages(self, batch: Any, periods: int) -> None:
        for topic, changes, seed, early, through in batch:
            self.stack.inject(topic, changes, seed, early, through)
        self.stack.run(periods)

    @rule(
        batch=st.lists(_MESSAGE, **_BATCH),
        topic=st.sampled_from((*STREAMS, *GOALS)),
    )
    def odd_messages_of_one_topic(self, batch: Any, topic: str) -> None:
        for _, changes, seed, early, through in batch:
            self.stack.inject(topic, changes, seed, early, through)
            self.stack.run(seed % 4 == 0)

    odd_messages_again = odd_messages
    odd_messages_of_one_topic_again = odd_messages_of_one_topic

    @rule(periods=st.integers(1, 30))
    def time_passes(self, periods: int) -> None:
        self.stack.run(periods)

    @rule(seed=st.integers(0, 255))
    def a_good_goal(self, seed: int) -> None:
        self.stack.good_goal(seed)
        self.stack.run(5)

    @rule(changes=st.lists(_parameter(), min_size=1, max_size=4))
    def parameters_change(self, changes: Any) -> None:
        for node, message in changes:
            if node in self.stack.nodes:
                self.stack.set_parameters(node, [message])
        self.stack.run(2)

    @rule(seconds=st.sampled_from((0.003, 0.03, 0.3, 1.5, 30.0, 4000.0)))
    def the_machine_stalls(self, seconds: float) -> None:
        self.stack.wire.stall(seconds)
        self.stack.run(2)

    @rule(name=st.sampled_from(tuple(STREAMS)), periods=st.integers(1, 60))
    def a_stream_is_lost(self, name: str, periods: int) -> None:
        self.stack.away[name] = periods
        self.stack.run(periods)

    @precondition(lambda self: self._restarts < 3)
    @rule(
        name=st.sampled_from(
            ("bounds_node", "controller_node", "estimator_node", "scenario_node")
        ),
        periods=st.integers(0, 20),
    )
    def a_node_goes_or_comes(self, name: str, periods: int) -> None:
        stack = self.stack
        if name == "estimator_node" and not stack.estimated:
            return
        self._restarts += 1
        (stack.leave if name in stack.nodes else stack.start)(name)
        stack.run(periods)

    @rule(topic=st.sampled_from(tuple(STREAMS)), periods=st.integers(0, 10))
    def a_rival_comes_or_goes(self, topic: str, periods: int) -> None:
        self.stack.rival(topic)
        self.stack.run(periods)

    @rule(what=st.sampled_from(("pause", "resume", "reset", "position", "torque", "tare")))
    def a_service_is_called(self, what: str) -> None:
        stack = self.stack
        if what == "reset":
            stack.reset()
        elif what == "tare":
            stack.tare()
        elif what in ("pause", "resume"):
            stack.pause(what == "pause")
        else:
            stack.enable_torque(what == "torque")
        stack.run(3)

    @precondition(lambda self: self._recoveries < 1)
    @rule()
    def causes_go_and_the_arm_tracks_again(self) -> None:
        self._recoveries += 1
        self.stack.recover()
