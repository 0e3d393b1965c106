# SPDX-License-Identifier: Apache-2.0
"""Robot and control on two hosts, in lockstep: what a bad network, and a busy machine, make of it.

bash scripts/reproduce.sh network [--runs N] [--seconds N]

The same classes as in the nodes, with the parameters of config/two_hosts/panda.yaml, and the
network of config/faults/two_hosts.yaml between them. A busy machine is one on which the control's
host stands still at random. Goals are random corners of the position limits, one every 2 s. *Kept*
is: no limit passed at any physics step, and no joint above 0.9 of its speed limit.
"""

from __future__ import annotations

import argparse
import heapq
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from functools import partial
from itertools import count
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from chain import load_node_values
from direct import DirectLoop
from figure import Figure, table, verdict
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from sim_bridge.nodes.bullet_parameters import make_stop
from sim_bridge.nodes.command_stream import CommandStream
from torque_safety_controller.node.recovery import Recovery
from torque_safety_controller.node.streams.states import Arrival, StateStream
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.node.estimator_parameters import EstimatorConfiguration, make_estimator
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import joint_state

Array = NDArray[np.float64]

ROBOT, HOSTS = "panda", "two_hosts/panda"
GOALS = 2.0  # s from one to the next
COMPUTES = 0.0015  # s that the control takes for a state
FAST = 0.9  # share of a speed limit
HEADS = (
    "the control's host stands still",
    "`disturbance_time`, s",
    "beyond a limit of position, speed",
    "nearest a position limit, rad",
    "fastest, share of `velocity_max`",
    f"moments above {FAST:g}",
    "acceleration where the robot's law does not guard, rad/s^2",
    "largest torque",
    "stops",
    "",
)


class Network(NamedTuple):
    """What happens between the hosts, and on that of the control.

    Attributes:
        lost: share of the messages in each direction.
        jitter: longest way of one that is not, s.
        stalls: probability that the control begins to stand still in a control period.
        longest: of the times for which it does, s.
    """

    lost: float = 0.05
    jitter: float = 0.02
    stalls: float = 0.0
    longest: float = 0.2


FREE, BUSY, BUSIER = Network(), Network(stalls=0.01), Network(stalls=0.03)
MACHINES = {
    "never": FREE,
    "twice a second, up to 0.2 s": BUSY,
    "six times a second, up to 0.2 s": BUSIER,
}


class Outcome(NamedTuple):
    """What a run came to.

    Attributes:
        position, speed: by how much a limit was passed, rad and rad/s.
        nearest: to a position limit, rad.
        fastest: share of a speed limit.
        moments: how often a joint came to be faster than `FAST`.
        unguarded: largest mean acceleration of a period in which the robot's own law did not guard
            the command, rad/s^2.
        torque: largest, as a share of its limit.
        held: periods in which the last command was held.
        stops: how often the robot stopped itself.
    """

    position: float
    speed: float
    nearest: float
    fastest: float
    moments: int
    unguarded: float
    torque: float
    held: int
    stops: int


class Control:
    """Estimator, bounds and controller of a loop, as their nodes use them.

    Args:
        loop: with the robot.
    """

    def __init__(self, loop: DirectLoop) -> None:
        self._loop = loop
        config = loop._controller_configuration()
        robot = loop._configuration("estimator_node", EstimatorConfiguration)
        self._estimator = make_estimator(robot, loop.model)
        self._states = StateStream(config.joints, config.state_timeout)
        covered, tau_max = loop.config.missed_deadlines, loop.config.torque_max
        way = 3 + robot.declared.delay + covered  # as of `longest_way`
        self._tau_max = tau_max
        self._recovery = Recovery(
            loop.controller, self._states, config, covered, way, lambda _: None
        )

    def answer(self, message: JointState, now: float) -> Array | None:
        """Return torques that answer a state, shape (n,), N m; None for no answer."""
        states, recovery, loop = self._states, self._recovery, self._loop
        arrival = states.take(message, now)
        if arrival not in (Arrival.NEXT, Arrival.ANEW, Arrival.BACK):
            return None
        reported = State(states.q, states.v)
        state = self._estimator.step(states.stamp, reported, states.effort())
        if arrival is not Arrival.NEXT:
            if states.missed:
                recovery.why = "joint states were missing"
            states.begin()
            recovery.motors.reset()
            loop.controller.reset(state.q)
        if not recovery.sees_motors():
            states.answered()
            return None
        recovery.slow()
        recovery.look()
        lower, upper, _ = loop.bounds(state.q, state.v)
        step = loop.controller.step(state, AccelerationRange(lower, upper), states.elapsed())
        recovery.note(step)
        recovery.motors.note(step.tau)
        states.answered()
        tau = np.clip(step.tau, -self._tau_max, self._tau_max)
        self._estimator.answer(states.stamp, tau)
        return tau


class TwoHosts(DirectLoop):
    """A robot, its control, and the network between them.

    Args:
        network: what happens between them.
        seed: of what is random.
        changed: parameters that differ from the files.
    """

    def __init__(self, network: Network, seed: int, changed: dict[str, Any] | None = None) -> None:
        super().__init__(ROBOT, changed, [HOSTS])
        self._network, self._random = network, np.random.default_rng(seed)
        self._law = make_stop(self.config)
        assert self._law is not None
        self._control = Control(self)
        self._commands = CommandStream(self.config, Counter(), lambda: True, lambda _: None)
        # What is under way: when it comes, a number, and the message; of states and of commands.
        self._states: list[tuple[float, int, JointState]] = []
        self._answers: list[tuple[float, int, JointState]] = []
        self._numbers = count()
        self._free_at = 0.0
        self._stamp, self._dt_ns = 0, round(1e9 * self.dt)
        self.unguarded, self.held, self.stops = 0.0, 0, 0
        self._stopped, self._no_torque = False, np.zeros(len(self.config.joints))

    def _send(self, line: list[tuple[float, int, JointState]], now: float, it: JointState) -> None:
        network, random = self._network, self._random
        if random.random() >= network.lost:
            at = now + network.jitter * random.random()
            heapq.heappush(line, (at, next(self._numbers), it))

    def play(self) -> Array:
        """Play a control period; return the speeds at its end, shape (n,), rad/s."""
        random, network, robot = self._random, self._network, self.robot
        self._stamp += self._dt_ns
        begin = 1e-9 * self._stamp
        end = begin + self.dt
        q, v, tau = robot.state()
        self._send(self._states, begin, joint_state(self.config.joints, self._stamp, q, v, tau))
        if random.random() < network.stalls:
            self._free_at = max(self._free_at, begin) + random.uniform(0.0, network.longest)
        while self._states and max(self._states[0][0], self._free_at) < end:
            at, _, message = heapq.heappop(self._states)
            at = max(at, self._free_at)
            answer = self._control.answer(message, at)
            if answer is not None:
                self._free_at = at = at + COMPUTES
                command = joint_state(self.config.joints, 0, tau=answer)
                command.header.stamp = message.header.stamp
                self._send(self._answers, at, command)
        commands, ended = self._commands, False
        while self._answers and self._answers[0][0] < end:
            message = heapq.heappop(self._answers)[-1]
            taken = commands.take(message, self._stamp, 0.0, ended=ended, paused=False)
            ended = ended or taken
        if not ended:
            commands.receive(None)
        guarded = self._act()
        after = robot.state().v
        if not guarded:
            self.unguarded = max(self.unguarded, float(np.abs(after - v).max()) / self.dt)
        return np.abs(after)

    def _act(self) -> bool:
        """Let the robot's node do its part; return whether its own law guards the command."""
        commands, config = self._commands, self.config
        row = commands.missed_in_row
        if commands.acting is None and not row:  # the brakes, until the first command
            self.robot.brake(config.substeps, config.torque_max)
            return True
        self.held += 0 < row <= config.command_timeout
        self.stops += commands.acting is None and not self._stopped
        self._stopped = commands.acting is None
        guarded = row > 0 or self.robot.returning
        self.act(self._law, self._no_torque if self._stopped else commands.acting.tau, row)
        return guarded


def play(
    seed: int, network: Network, seconds: float, changed: dict[str, Any] | None = None
) -> Outcome:
    """Play a run of some seconds; see `TwoHosts`."""
    loop = TwoHosts(network, seed, changed)
    config, random = loop.config, np.random.default_rng(seed)
    low, high = config.position_min, config.position_max
    shares, every = [0.0], round(GOALS / loop.dt)
    with closing(loop.robot):
        for k in range(round(seconds / loop.dt)):
            if k % every == 0:
                corner = np.where(random.random(low.size) < 0.5, low, high)
                loop.controller.set_posture_goal(corner)
            shares.append(float((loop.play() / config.velocity_max).max()))
        monitor, fast = loop.robot.monitor, np.array(shares) > FAST
        return Outcome(
            float(monitor.max_position_violation.max()),
            float(monitor.max_velocity_violation.max()),
            float(min(monitor.closest_to_q_min.min(), monitor.closest_to_q_max.min())),
            max(shares),
            int((fast[1:] & ~fast[:-1]).sum()),
            loop.unguarded,
            float(monitor.max_torque_ratio.max()),
            loop.held,
            loop.stops,
        )


def main() -> int:
    """Play all; return 1 where a limit was passed with the parameters of the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=20, help="of each kind (default: 20)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of a run (default: 30)")
    options = parser.parse_args()
    short = load_node_values(ROBOT)["controller_node"]["disturbance_time"]
    own = load_node_values(ROBOT, HOSTS)["controller_node"]["disturbance_time"]
    figure, kept = Figure("network"), True
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        for machine, network in MACHINES.items():
            for time in (own, short):
                changed = {"disturbance_time": time}
                one = partial(play, network=network, seconds=options.seconds, changed=changed)
                runs = list(pool.map(one, range(options.runs)))
                worst = Outcome(*map(max, zip(*runs, strict=True)))
                good = worst.position <= 0.0 and worst.speed <= 0.0 and worst.fastest < FAST
                kept &= good or time != own
                figure.rows.append(
                    (
                        machine,
                        f"{time:g}",
                        f"{worst.position:.2g}, {worst.speed:.2g}",
                        f"{min(run.nearest for run in runs):.2g}",
                        f"{worst.fastest:.2f}",
                        str(sum(run.moments for run in runs)),
                        f"{worst.unguarded:.0f}",
                        f"{worst.torque:.2f}",
                        str(sum(run.stops for run in runs)),
                        verdict(good, "kept") if time == own else "for comparison",
                    )
                )
    print(table([figure], HEADS))
    return int(not kept)


if __name__ == "__main__":
    raise SystemExit(main())
