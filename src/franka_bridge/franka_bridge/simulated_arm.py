# SPDX-License-Identifier: Apache-2.0
"""A Franka arm in MuJoCo that speaks libfranka's protocol, by franky-sim."""

from __future__ import annotations

import time

import mujoco
import numpy as np
from franky_sim.franka_robot_protocol import UDPCommand
from franky_sim.franka_robot_server import FrankaRobotServer
from franky_sim.mujoco_simulator import FrankaMujocoRobot, MujocoSimulator
from numpy.typing import NDArray

from franka_bridge.limit_watch import LimitWatch
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

DT = 1e-3  # s, of libfranka's periods and of the physics

_PATIENCE = 0.5
"""How long an arm that waits for commands waits for one: libfranka gives up after 1 s, s."""

_POLL = 5e-5  # s

_LEAVE_TIMEOUT = 3.0
"""How long a client may take to leave at the end, s."""

_HOLDING = {"kp": (2000.0,) * 4 + (500.0,) * 3, "kv": (100.0,) * 4 + (20.0,) * 3}
"""Gains that hold the arm without torque control: franky-sim's need friction in the joints."""

_NAMES = {"fr3_hand": "hand", "fr3_hand_tcp": "hand"}
"""Bodies of links that MuJoCo's model calls otherwise."""


class SimulationError(ArmSafetyError, RuntimeError):
    """The simulated arm cannot be started, or not be pushed."""


class _Server(FrankaRobotServer):
    """franky-sim's server, which also keeps the torques that came since the last period."""

    def __init__(self, robot: FrankaMujocoRobot, address: str) -> None:
        self.came: list[Array] = []
        self.controlled = False
        self._last = self._answered = -1  # numbers of states
        super().__init__(robot, [address])

    def receive(self) -> bool:
        """Take what has come; return whether the last state is answered, or control has ended."""
        self._process_udp_commands()
        return self._answered >= self._last or not self.controlled

    def send_state(self) -> None:
        """Send the next state."""
        super().send_state()
        self._last += self.udp_connected

    def reset_state(self) -> None:
        """Begin with a new client, or with none."""
        self._last = self._answered = -1
        self.controlled = False
        super().reset_state()

    def _handle_udp_command(self, command_data: bytes) -> None:
        super()._handle_udp_command(command_data)
        command = UDPCommand.from_bytes(command_data)
        self.controlled = not command.torque_command_finished
        self._answered = command.message_id
        self.came.append(np.array(command.tau_J_d))


class SimulatedArm:
    """An arm whose states and torques `watch` judges in each period of 1 ms.

    The joints are without friction and damping, as libfranka's torques are said to be. Links pass
    through each other: the convex hulls of link 5 and the hand touch long before joint 7 is at a
    limit. Rotors, masses and stops of the joints are those of franky-sim, which has no reflexes.

    Args:
        address: at which it listens, port 1337.
        start: positions, shape (7,), rad.
        watch: of its limits.
        waits: whether time waits for the commands of a client, 0.5 s for each; else it is that of
            the wall clock. A period without a command keeps the last one.

    Attributes:
        periods: simulated under torque control.
        missed: those of them without a command.
        late: periods by which the simulation itself was late.

    Raises:
        SimulationError: the address is taken.
    """

    def __init__(self, address: str, start: Array, watch: LimitWatch, waits: bool) -> None:
        self._simulator = MujocoSimulator()
        self._simulator.init()
        self._robot = self._simulator.add_robot(initial_q=start.tolist(), **_HOLDING)
        self._server = _Server(self._robot, address)
        try:
            self._server.init()
        except OSError as error:
            raise SimulationError(
                f"no robot can listen at {address}, port 1337: {error}"
            ) from error
        self._simulator.start()
        self.watch, self._waits = watch, waits
        model, joints = self._simulator.model, self._robot._dof_addrs
        model.dof_frictionloss[joints] = model.dof_damping[joints] = 0.0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self._sent, self._asked = np.zeros((2, len(joints)))
        self._robot._torque_control = self._drive
        self.periods = self.missed = self.late = 0
        self._due = time.monotonic()

    def step(self) -> None:
        """Simulate a period: receive commands, move, send the state."""
        server, robot = self._server, self._robot
        if server.controlled:
            self._await()
            self.periods += 1
            self.missed += not server.came
        server.process_commands()
        for torque in server.came:
            self.watch.sent(torque, self._sent)
            self._sent = torque
        server.came.clear()
        if not server.controlled:
            self._sent = np.zeros_like(self._sent)
        self._simulator.step()
        server.send_state()
        state = robot.inner_state
        asked = self._asked if server.controlled else self._sent  # its own law is not judged
        self.watch.update(np.array(state.q), np.array(state.dq), asked)
        if not (self._waits and server.controlled):
            self._keep_time()

    def push(self, link: str, force: Array, torque: Array) -> None:
        """Let a force, N, and a torque, N m, in world axes act on a link from now on.

        Raises:
            SimulationError: there is no such link.
        """
        model, data = self._simulator.model, self._simulator.data
        body = mujoco.mj_name2id(
            model, mujoco.mjtObj.mjOBJ_BODY, f"robot0_{_NAMES.get(link, link)}"
        )
        if body < 0:
            raise SimulationError(f"the simulated arm has no link {link!r}")
        data.xfrc_applied[body] = [*force, *torque]

    def close(self) -> None:
        """Stop listening when the client has left, which may bring the arm to rest before."""
        self._waits, end = False, time.monotonic() + _LEAVE_TIMEOUT
        while self._server.tcp_connected and time.monotonic() < end:
            self.step()
        self._server.cleanup()
        self._simulator.cleanup()

    def _drive(self, torques: Array) -> None:
        """Let the motors give torques, N m, with gravity, as far as they can."""
        self._asked = torques.copy()
        FrankaMujocoRobot._torque_control(self._robot, torques)

    def _await(self) -> None:
        """Wait for a command, where the arm waits for one."""
        end = time.monotonic() + _PATIENCE if self._waits else 0.0
        while not self._server.receive():
            if time.monotonic() > end:
                return
            time.sleep(_POLL)

    def _keep_time(self) -> None:
        """Wait for the end of the period on the wall clock."""
        self._due += DT
        left = self._due - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        elif left < -DT:
            self.late += 0 if self._waits else int(-left / DT)
            self._due = time.monotonic()
