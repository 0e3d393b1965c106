# SPDX-License-Identifier: Apache-2.0
"""Nodes that end, stand still, or start at random moments, in real time: limits, braking, return.

bash scripts/reproduce.sh process-faults [--robot NAME] [--fault NAME] [--moments N] [--rate HZ]
    [--hold PERIODS]

Bounds and controller are processes, or one where there is an estimator, too. The robot is in
this one, so that its limits are judged at its physics steps; where the fault is the robot's own,
it is a process, and its diagnostics count. Goals are random corners of the position limits, one a
second, with stiff gains; the user sends them again five times a second, as a controller that was
started anew knows of none.
"""

from __future__ import annotations

import argparse
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from chain import ROOT, load_node_values
from figure import Figure, table
from moments import (
    AGAIN,
    HEADS,
    RETURN,
    ROBOTS,
    STIFF,
    Corners,
    Sample,
    Seen,
    at_rate,
    parameter_words,
)
from numpy.typing import NDArray
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from watched_robot import STOPS, WatchedRobot

from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.safety.modes import Mode
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import Parameter as Row
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.ros.runtime import GOAL_QOS, LATCHED_QOS, set_stamp
from viability_bounds_pkg.ros.topics import JOINT_STATES, ROBOT_DESCRIPTION
from viability_bounds_pkg.testing.node_program import NodeProgram
from viability_bounds_pkg.testing.ros_harness import (
    RosHarness,
    joint_state,
    overrides,
    private_domain,
)

BOUNDS, CONTROLLER = "bounds_node", "controller_node"
ROBOT, ESTIMATOR = "bullet_node", "estimator_node"
CONTROL = BOUNDS, CONTROLLER
TOGETHER = "bounds_and_controller"
"""Both as one process: two processors do not keep 1 kHz with a process for each node."""
ALONE = {
    BOUNDS: "acceleration_limits",
    CONTROLLER: "joint_commands",
    ROBOT: "joint_states",
    ESTIMATOR: "estimated_joint_states",
    TOGETHER: "joint_commands",
}
"""What each program alone publishes."""

_TOGETHER = [sys.executable, str(Path(__file__).with_name(f"{TOGETHER}.py"))]

Array = NDArray[np.float64]

IMPERFECT_RATE = 500.0  # Hz, least: estimates are worse at a lower rate
START = 60.0  # s, in which nodes must start
STILL = 0.05, 1.0  # s, shortest and longest time in which a node stands still
APART = 1.0  # s between starts of nodes
GOAL_PERIOD, SENT_AGAIN = 1.0, 0.2  # s
CALM = 1.0, 2.0  # s, shortest and longest time of motion before a fault
WILD = 1.0  # s, in which parameters change, or the clock jumps
NOT_WILD = "method", "friction_", "integral_anti_windup", "integral_lambda"
"""Live parameters that choose what keeps no limits, for comparison, or say what is so; and a gain
that is tried by itself."""

Course = Iterator[None]
"""What happens: goes on when asked for the next, and ends when the cause has gone."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    Attributes:
        course: what happens to a bench.
        programs: nodes that run as processes; the robot is in this one where it is not among them.
        imperfect: whether the robot is, and its states are estimated.
        late: node that does not start with the others, but by the course; each moment has nodes of
            its own then.
        values: parameters of all nodes that differ.
        brakes: whether the arm has to be brought to rest.
        halts: whether its time stands still: it goes on in the middle of its motion, in which
            torques step without a fault, too.
    """

    course: Callable[[Bench], Course]
    programs: tuple[str, ...] = CONTROL
    imperfect: bool = False
    late: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)
    brakes: bool = True
    halts: bool = False


class Bench:
    """A robot under control.

    Args:
        ros: runs the robot and the user.
        robot: name of its file.
        kind: how it is to run.
        rng: random numbers.
        rate: of the control loop, Hz; None for the robot's own.
        hold: periods for which the robot holds a command; None for the robot's own.

    Attributes:
        programs: by name.
        arm: the robot in this process; None where it is a process or has not started.
        rng: as given.
        limits: parameters of the robot.
        dt: control period, s.
        heard: whether there was a joint state.
        clock_ahead: of the time that nodes with `use_sim_time` are told, s.
    """

    def __init__(
        self,
        ros: RosHarness,
        robot: str,
        kind: Kind,
        rng: np.random.Generator,
        rate: float | None,
        hold: int | None = None,
    ) -> None:
        self.ros, self.rng, self._kind = ros, rng, kind
        more = [f"imperfect/{robot}"] * kind.imperfect
        changes = STIFF | {"start_paused": False, "clock": "real_time"} | dict(kind.values)
        found = load_node_values(robot, *more)
        if kind.imperfect:
            rate = rate and max(rate, IMPERFECT_RATE)
            # Noise of the torques would count as their steps.
            changes["current_noise"] = [0.0] * len(found[ROBOT]["joints"])
        elif hold is not None:
            changes["command_timeout"] = hold
        by_node = {name: changes | own for name, own in at_rate(found, rate).items()}
        self._own = {name: own | by_node[name] for name, own in found.items()}
        values = self._own[ROBOT]
        if "robot_description" in kind.values:  # the robot itself cannot take it from the topic
            values["robot_description"] = load_node_values(robot)[ROBOT]["robot_description"]
        self.dt = 1.0 / values["rate_hz"]
        self._joints, self._tau_max = values["joints"], np.array(values["torque_max"])
        self.limits = values
        words = ["--ros-args", "--log-level", "error"]
        for each in (robot, *more):
            words += ["--params-file", str(ROOT / "config" / f"{each}.yaml")]
        by_node[ROBOT] = {name: values[name] for name in by_node[ROBOT]}
        self.programs = {}
        for name in kind.programs:
            nodes = CONTROL if name == TOGETHER else (name,)
            own = [word for node in nodes for word in parameter_words(node, by_node[node])]
            start = _TOGETHER if name == TOGETHER else None
            self.programs[name] = NodeProgram(
                name, ros.domain, [*words, *own], subprocess.DEVNULL, start
            )
        self.arm: Any = None
        self.heard = False
        self._mode = ""
        self._trace: list[Sample] = []
        self._goal, self._corners = np.array(values["start_positions"]), Corners(values, rng)
        self._asked = self._sent = -math.inf
        self._user = ros.probe.create_publisher(JointState, "target_posture", GOAL_QOS)
        self._clock = ros.probe.create_publisher(Clock, "/clock", 1)
        self._marked = -math.inf
        self._clients: dict[Any, dict[str, Any]] = {}
        self.clock_ahead, self._clock_at = 0.0, -math.inf
        ros.probe.create_subscription(String, "controller_mode", self._on_mode, LATCHED_QOS)
        ros.probe.create_subscription(
            JointState, JOINT_STATES.name, self._on_state, JOINT_STATES.qos
        )

    # What is seen

    @property
    def timeout(self) -> int:
        """Periods after a command in which the robot does not stop itself."""
        own = self._own[ROBOT]
        return own.get("command_timeout", 5) + own.get("command_delay", 0)

    @property
    def tracking(self) -> bool:
        """Whether the arm follows its goal, as far as it is known now."""
        return self._mode == Mode.TRACKING.value and not self._stopped()

    def _stopped(self) -> bool:
        return self.arm is not None and self.arm._control() in STOPS

    def _on_mode(self, message: String) -> None:
        self._mode = message.data
        if self.arm is None:  # perhaps there is no state any more
            nothing = np.full(len(self._joints), np.nan)
            self._trace.append(Sample(self.now(), not self.tracking, False, nothing))

    def _see(self, t: float, stopped: bool, tau: Array) -> None:
        """Take a state of the robot in this process."""
        self.heard = True
        braking = stopped or self._mode != Mode.TRACKING.value
        self._trace.append(Sample(t, braking, stopped, tau))

    def _on_state(self, message: JointState) -> None:
        if self.arm is not None:
            return
        self.heard = True
        tau = dict(zip(message.name, message.effort, strict=True))
        torques = np.array([tau[joint] for joint in self._joints])
        if not torques.any():  # the first state of a robot that has started: nothing has acted
            torques.fill(np.nan)
        self._trace.append(Sample(self.now(), not self.tracking, False, torques))

    def now(self) -> float:
        """Return robot time, s; that of this computer where the robot is a process."""
        return time.monotonic() if self.arm is None else 1e-9 * float(self.arm._stamp)

    def publishers(self, name: str) -> int:
        """Return how many nodes publish what one node alone should."""
        return self.ros.probe.count_publishers(ALONE[name])

    # What is done

    def start(self, name: str) -> None:
        """Start a node."""
        if name in self.programs:
            self.programs[name].start()
            return
        own = {k: v for k, v in self._own[name].items() if v != []}
        node = WatchedRobot(
            self._see, context=self.ros.context, parameter_overrides=overrides(own)
        )
        self.arm = self.ros.add(node)

    def start_all(self) -> None:
        """Start all nodes but the late one, and wait for them."""
        names = [
            each for each in dict.fromkeys((ROBOT, *self.programs)) if each != self._kind.late
        ]
        for name in names:
            self.start(name)

        def there() -> bool:
            started = [each for name, each in self.programs.items() if name in names]
            assert all(each.running for each in started), "a node could not start"
            return all(map(self.publishers, names))

        self.ros.wait_until(there, "the nodes", timeout=START)

    def close(self) -> None:
        """End all programs."""
        for program in self.programs.values():
            program.end()

    def ask(self, publisher: Any) -> None:
        """Publish a goal that is not the user's."""
        publisher.publish(joint_state(self._joints, 0, self._corners.draw()))

    def spin(self) -> None:
        """Run callbacks for a moment, and do what the user does."""
        now = time.monotonic()
        if now - self._sent > SENT_AGAIN:
            self._sent = now
            self._user.publish(joint_state(self._joints, 0, self._goal))
        if self._kind.values.get("use_sim_time") and now - self._clock_at > 0.01:
            self._clock_at = now
            message = Clock()
            set_stamp(message.clock, round(1e9 * max(0.0, now + self.clock_ahead)))
            self._clock.publish(message)
        self.ros.spin(0.01)

    def mark(self) -> None:
        """Let the fault have begun now, and not when its course began."""
        self._marked = self.now()

    def wait(self, duration: float) -> Course:
        """Let time pass, s."""
        end = time.monotonic() + duration
        while time.monotonic() < end:
            yield

    def until_back(self, name: str) -> Course:
        """Start a node that was ended; let time pass until it is in the ROS graph again.

        One that was killed stays in the graph for a while.
        """
        fewest = self.publishers(name)
        self.programs[name].start()
        while (count := self.publishers(name)) <= fewest:
            fewest = min(count, fewest)
            assert self.programs[name].running, f"{name} ended"
            yield

    def call(self, node: str, kind: Any, request: Any) -> Generator[None, None, Any]:
        """Call a service of a node about its parameters; let time pass; return the answer."""
        if kind not in self._clients:
            name = "get_parameters" if kind is GetParameters else "set_parameters"
            self._clients[kind] = {
                each: self.ros.probe.create_client(kind, f"{each}/{name}") for each in ALONE
            }
        client = self._clients[kind][node]
        while not client.service_is_ready():
            yield
        answer = client.call_async(request)
        while not answer.done():
            yield
        return answer.result()

    def set(self, node: str, values: Mapping[str, Any]) -> Generator[None, None, list[str]]:
        """Set parameters of a node; return why some were refused."""
        messages = [Parameter(k, value=v).to_parameter_msg() for k, v in values.items()]
        request = SetParameters.Request(parameters=messages)
        answer = yield from self.call(node, SetParameters, request)
        return [result.reason for result in answer.results if not result.successful]

    def motion(self, duration: float) -> None:
        """Let the arm follow one goal after the other for so long without a pause, s."""
        since, begin = time.monotonic(), time.monotonic()
        while time.monotonic() - since < duration:
            now = time.monotonic()
            assert now - begin < START, f"the arm does not go on: {self._mode}"
            if now - self._asked > GOAL_PERIOD:
                self._asked, self._sent = now, -math.inf
                self._goal = self._corners.draw()
            self.spin()
            if not self.tracking:
                since = now

    def suffer(self, seen: Seen, course: Course) -> None:
        """Let something happen, and see what comes of it.

        Args:
            seen: what came of it is added to this.
            course: what happens.
        """
        self._trace.clear()
        begin = self.now() if self.heard else math.nan
        deadline = time.monotonic() + START
        for _ in course:
            assert time.monotonic() < deadline, "what happens to the nodes does not end"
            self.spin()
        while not self._trace:
            self.spin()
        if math.isnan(begin):  # there was no robot
            begin = self._trace[0].t
        end = max(self.now(), begin + self.dt)
        since = math.inf
        while self.now() < end + AGAIN + 0.5 and time.monotonic() - since < 3.0 * RETURN:
            self.spin()
            since = min(since, time.monotonic()) if self.tracking else math.inf
        begin = max(begin, self._marked)
        seen.note_moment(self._trace, begin, end, self.dt, self._tau_max)
        if self._kind.halts:
            seen.steps.clear()

    def note_limits(self, seen: Seen) -> None:
        """Add how far limits were passed until now."""
        if self.arm is not None:
            seen.note_limits(self.arm._monitor)
            return
        diagnostics = self.ros.diagnostics
        diagnostics.pop(ROBOT, None)
        end = time.monotonic() + START
        while ROBOT not in diagnostics and time.monotonic() < end:
            self.spin()

        def worst(key: str) -> float:
            return max(map(float, diagnostics[ROBOT][key].split()))

        seen.position = max(seen.position, worst("position_violation_rad"))
        seen.speed = max(seen.speed, worst("velocity_violation_rad_s"))
        seen.torque = max(seen.torque, worst("torque_ratio"))


# What happens


def killed(name: str) -> Callable[[Bench], Course]:
    """A node is killed, and started again at once."""

    def course(bench: Bench) -> Course:
        bench.programs[name].kill()
        yield from bench.until_back(name)

    return course


def restarted(name: str) -> Callable[[Bench], Course]:
    """A node is told to end, and started again at once."""

    def course(bench: Bench) -> Course:
        before = bench.publishers(name)
        bench.programs[name].send(signal.SIGTERM)
        while bench.programs[name].running and bench.publishers(name) >= before:
            yield
        bench.mark()  # it has answered until now
        while bench.programs[name].running:
            yield
        yield from bench.until_back(name)

    return course


def stood_still(*names: str, least: float = STILL[0]) -> Callable[[Bench], Course]:
    """Nodes stand still for a random time, at least for `least`, s."""

    def course(bench: Bench) -> Course:
        for name in names:
            bench.programs[name].stand_still()
        yield from bench.wait(bench.rng.uniform(least, STILL[1]))
        for name in names:
            bench.programs[name].go_on()

    return course


def wild_parameters(bench: Bench) -> Course:
    """Live parameters of bounds and controller change at random, then are what they were."""
    return _wild(bench, lambda name: not name.startswith(NOT_WILD))


def wild_integral(bench: Bench) -> Course:
    """The integral action changes at random, then is what it was."""
    return _wild(bench, lambda name: name in ("integral_action", "integral_lambda"))


def _wild(bench: Bench, chosen: Callable[[str], bool]) -> Course:
    kinds = {BOUNDS: BoundsConfiguration, CONTROLLER: ControllerConfiguration}
    rows = {
        name: [row for row in parameter_table(kind) if row.live and chosen(row.name)]
        for name, kind in kinds.items()
    }
    rows = {name: found for name, found in rows.items() if found}
    nodes = list(rows)
    before = {}
    for node in rows:
        names = [row.name for row in rows[node]]
        found = yield from bench.call(node, GetParameters, GetParameters.Request(names=names))
        values = map(parameter_value_to_python, found.values)
        # Lists that were left out are not set.
        before[node] = {
            each: [] if value is None else value for each, value in zip(names, values, strict=True)
        }
    end = time.monotonic() + WILD
    while time.monotonic() < end:
        node = nodes[bench.rng.integers(len(nodes))]
        row = rows[node][bench.rng.integers(len(rows[node]))]
        value = wild_value(row, bench.limits["joints"], bench.rng)
        yield from bench.set(node, {row.name: value})
    for node, values in before.items():
        # Twice: one that must agree with another may be refused until that is back.
        for _ in range(2):
            refused = yield from bench.set(node, values)
        assert not refused, refused


def wild_value(row: Row, joints: list[str], rng: np.random.Generator) -> Any:
    """Return a value of a parameter: allowed and extreme, or one that must be refused."""
    if rng.random() < 0.3:
        wrong = (math.nan, math.inf, -1e9, 1e300, "much", [1.0], [math.nan] * len(joints), True)
        return wrong[rng.integers(len(wrong))]
    if row.choices:
        return row.choices[rng.integers(len(row.choices))]
    low = max(row.within.low, 1e-4) if row.within else 1e-4
    high = min(row.within.high, 1e5) if row.within else 1e3

    def one() -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    if row.kind is float:
        return one()
    return [one() for _ in range(row.length or len(joints))]


def clock_jumps(bench: Bench) -> Course:
    """The clock of all nodes jumps to and fro, and stands still."""
    end = time.monotonic() + WILD
    while time.monotonic() < end:
        bench.clock_ahead = float(bench.rng.choice((-1e6, -10.0, -0.1, 0.1, 10.0, 1e6)))
        yield from bench.wait(bench.rng.uniform(0.02, 0.2))
    bench.clock_ahead = 0.0


def no_room(bench: Bench) -> Course:
    """The disk is full when the nodes have much to log, as the bounds node stands still."""
    for program in bench.programs.values():
        program.fill_disk()
    yield from stood_still(BOUNDS)(bench)
    for program in bench.programs.values():
        program.empty_disk()


def other_description(bench: Bench) -> Course:
    """Somebody publishes the description of a heavier robot."""
    urdf = bench.arm._config.urdf.replace('mass value="', 'mass value="1')
    assert urdf != bench.arm._config.urdf
    publisher = ROBOT_DESCRIPTION.publisher(bench.ros.probe)
    publisher.publish(String(data=urdf))
    yield from bench.wait(bench.rng.uniform(*STILL))
    bench.ros.probe.destroy_publisher(publisher)


def another_user(bench: Bench) -> Course:
    """Another node publishes goals, too."""
    node = bench.ros.add(Node("another_user", context=bench.ros.context))
    publisher = node.create_publisher(JointState, "target_posture", GOAL_QOS)
    while not publisher.get_subscription_count():
        yield
    bench.mark()
    end = time.monotonic() + WILD
    while time.monotonic() < end:
        bench.ask(publisher)
        yield from bench.wait(0.02)
    bench.ros.stop(node)


def nothing(bench: Bench) -> Course:
    """What the others are compared with."""
    yield from bench.wait(0.5)


def late(name: str) -> Callable[[Bench], Course]:
    """A node starts later than all others."""

    def course(bench: Bench) -> Course:
        bench.start(name)
        while not bench.publishers(name):
            yield

    return course


WITH_ROBOT = (ROBOT, *CONTROL)
WITH_ESTIMATOR = ESTIMATOR, TOGETHER
FAULTS = {
    "nothing": Kind(nothing, brakes=False),
    "nothing, imperfect robot": Kind(nothing, WITH_ESTIMATOR, imperfect=True, brakes=False),
    "bounds killed": Kind(killed(BOUNDS)),
    "bounds restarted": Kind(restarted(BOUNDS)),
    "bounds stopped and continued": Kind(stood_still(BOUNDS)),
    "controller killed": Kind(killed(CONTROLLER)),
    "controller restarted": Kind(restarted(CONTROLLER)),
    "controller stopped and continued": Kind(stood_still(CONTROLLER)),
    "both stopped and continued": Kind(stood_still(*CONTROL)),
    "estimator killed": Kind(killed(ESTIMATOR), WITH_ESTIMATOR, imperfect=True),
    "estimator restarted": Kind(restarted(ESTIMATOR), WITH_ESTIMATOR, imperfect=True),
    "estimator stopped and continued": Kind(
        stood_still(ESTIMATOR), WITH_ESTIMATOR, imperfect=True
    ),
    "robot killed": Kind(killed(ROBOT), WITH_ROBOT),
    "robot restarted": Kind(restarted(ROBOT), WITH_ROBOT),
    # The controller tells it within 100 ms.
    "robot stopped and continued": Kind(stood_still(ROBOT, least=0.2), WITH_ROBOT, halts=True),
    "bounds late": Kind(late(BOUNDS), late=BOUNDS),
    "controller late": Kind(late(CONTROLLER), late=CONTROLLER),
    "robot late": Kind(late(ROBOT), late=ROBOT),
    "wild parameters": Kind(wild_parameters, brakes=False),
    "wild integral action": Kind(wild_integral, brakes=False),
    "the clock jumps": Kind(clock_jumps, values={"use_sim_time": True}, brakes=False),
    "no room for logs": Kind(no_room),
    "another user": Kind(another_user),
    "another robot description": Kind(
        other_description, values={"robot_description": "topic"}, brakes=False
    ),
}


def play(
    robot: str, name: str, moments: int, seed: int, rate: float | None, hold: int | None
) -> tuple[Seen, float, str]:
    """Let a robot suffer a fault; return what it did, the control period, s, and why it ended."""
    kind, rng, why = FAULTS[name], np.random.default_rng(seed), ""
    seen = Seen(brakes=kind.brakes)
    for count in [1] * moments if kind.late else [moments]:
        with ExitStack() as stack:
            ros = RosHarness(stack.enter_context(private_domain()))
            stack.callback(ros.close)
            bench = Bench(ros, robot, kind, rng, rate, hold)
            stack.callback(bench.close)
            seen.timeout, dt = bench.timeout, bench.dt
            try:
                _suffer(bench, kind, seen, count)
            except AssertionError as error:
                why = str(error)
                if bench.heard:
                    bench.note_limits(seen)
    return seen, dt, why


def _suffer(bench: Bench, kind: Kind, seen: Seen, count: int) -> None:
    """Start the nodes and let them suffer so often."""
    bench.start_all()
    if kind.late:
        for _ in bench.wait(bench.rng.uniform(0.0, APART)):
            bench.spin()
        bench.suffer(seen, kind.course(bench))
        bench.motion(1.0)
        bench.note_limits(seen)
        return
    for _ in range(count):
        bench.motion(bench.rng.uniform(*CALM))
        bench.suffer(seen, kind.course(bench))
    bench.motion(CALM[0])
    bench.note_limits(seen)


def main() -> int:
    """Play, print the table; return whether all is as it should be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", action="append", choices=ROBOTS, help="only this one")
    parser.add_argument("--fault", action="append", choices=tuple(FAULTS), help="only this one")
    parser.add_argument("--moments", type=int, default=10, help="of each fault")
    parser.add_argument(
        "--rate",
        type=float,
        help="of the control loop, Hz; the robot's own; at a lower one its file is changed for it",
    )
    parser.add_argument(
        "--hold", type=int, help="periods for which the robot holds a command; the robot's own"
    )
    parser.add_argument("--seed", type=int, default=1, help="of goals and moments")
    given = parser.parse_args()
    # The time before the faults is not looked at.
    heads = (*HEADS[:3], "fault, s", *HEADS[3:-2], HEADS[-1])
    figure = Figure("process_faults")
    print(table([figure], heads), flush=True)
    for robot in given.robot or ROBOTS:
        for name in given.fault or FAULTS:
            seen, dt, why = play(robot, name, given.moments, given.seed, given.rate, given.hold)
            cells = seen.cells(dt)
            lasted = f"{min(seen.lasted):.2f} to {max(seen.lasted):.2f}" if seen.lasted else "-"
            said = f"FAILS: {why}" if why else cells[-1]
            figure.rows.append((robot, name, cells[0], lasted, *cells[1:-2], said))
            print("| " + " | ".join(figure.rows[-1]) + " |", flush=True)
    return int(any(row[-1] != "kept" for row in figure.rows))


if __name__ == "__main__":
    raise SystemExit(main())
