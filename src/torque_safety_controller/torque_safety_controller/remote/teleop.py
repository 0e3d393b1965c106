# SPDX-License-Identifier: Apache-2.0
"""Command line tool: jogs the arm by the keys of a terminal."""

from __future__ import annotations

import argparse
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Sequence

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from torque_safety_controller.node.topics import JOG_HAND, JOG_JOINTS
from viability_bounds_pkg.cli.command_line import Parser, positive, run_tool
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.parameter_files import read_files
from viability_bounds_pkg.robot.configuration import RobotConfiguration, TaskFrames
from viability_bounds_pkg.ros.runtime import settle_dds

HELP = """keys, while held:
  w s   hand along x        u o   hand about x
  a d   hand along y        i k   hand about y
  r f   hand along z        j l   hand about z
  1..9  joint, + or - as chosen with +  -
  t     axes of the base or of the hand
  space stop                x     stop and quit"""

AXES = {"ws": 0, "ad": 1, "rf": 2, "uo": 3, "ik": 4, "jl": 5}
"""Keys forwards and backwards, and the number in the twist."""

PERIOD = 0.05
"""Between two jogs, s."""

HELD = 0.5
"""How long a key counts as held, s: a terminal's first repetition comes so late."""


class Teleop:
    """Turns keys into jogs.

    Args:
        node: publishes them.
        joints: names of the joints, base to tip.
        frames: of the base and the hand.
        speeds: of the hand, m/s and rad/s, and of a joint, rad/s.
    """

    def __init__(
        self,
        node: Node,
        joints: Sequence[str],
        frames: tuple[str, str],
        speeds: tuple[float, float, float],
    ) -> None:
        self._hand, self._joints = JOG_HAND.publisher(node), JOG_JOINTS.publisher(node)
        self._names, self._frames, self._speeds = joints, frames, speeds
        self._frame, self._sign = 0, 1.0
        self._message: TwistStamped | JointState | None = None
        self._until = 0.0
        self._unheard = False

    def press(self, key: str, now: float) -> str:
        """Handle a key pressed at `now`, s; return what to tell the user, or nothing."""
        if key == "t":
            self._frame = 1 - self._frame
            return f"axes of {self._frames[self._frame]}"
        if key in "+-":
            self._sign = 1.0 if key == "+" else -1.0
            return f"joints in {key} direction"
        message = self._jog(key)
        if message is None or type(message) is not type(self._message):
            self.stop()
        self._message, self._until = message, now + HELD
        before, self._unheard = self._unheard, not self._hand.get_subscription_count()
        return "no controller is heard" if self._unheard and not before else ""

    def tick(self, now: float) -> None:
        """Publish the jog of the key that is held at `now`, s."""
        if now > self._until:
            self.stop()
        elif self._message is not None:
            self._publish(self._message)

    def stop(self) -> None:
        """Let what moves come to rest."""
        if isinstance(self._message, TwistStamped):
            self._publish(TwistStamped())
        elif self._message is not None:
            self._publish(JointState(name=[self._names[0]], velocity=[0.0]))
        self._message = None

    def _publish(self, message: TwistStamped | JointState) -> None:
        (self._hand if isinstance(message, TwistStamped) else self._joints).publish(message)

    def _jog(self, key: str) -> TwistStamped | JointState | None:
        if key in "123456789" and int(key) <= len(self._names):
            name = self._names[int(key) - 1]
            return JointState(name=[name], velocity=[self._sign * self._speeds[2]])
        for pair, axis in AXES.items():
            if key in pair:
                jog = TwistStamped()
                jog.header.frame_id = self._frames[self._frame]
                part = jog.twist.linear if axis < 3 else jog.twist.angular
                speed = self._speeds[axis // 3]
                setattr(part, "xyz"[axis % 3], speed if key == pair[0] else -speed)
                return jog
        return None


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="teleop",
        description="Jog an arm by the keys of this terminal.",
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_parameter_files()
    for name, default, unit in (
        ("--speed", 0.1, "m/s of the hand"),
        ("--turn", 0.5, "rad/s of the hand"),
        ("--joint-speed", 0.3, "rad/s of a joint"),
    ):
        text = f"{unit} (default: %(default)s)"
        parser.add_argument(name, type=positive, default=default, metavar="SPEED", help=text)
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    section = "/**/controller_node"
    joints = read_files(RobotConfiguration, options.params_file, section).joints
    frames = read_files(TaskFrames, options.params_file, section)
    if not sys.stdin.isatty():
        raise ArmSafetyError("standard input is no terminal: start it in one")
    settle_dds(os.environ)
    rclpy.init(args=[])
    node = Node("teleop", start_parameter_services=False)
    speeds = options.speed, options.turn, options.joint_speed
    teleop = Teleop(node, joints, (frames.base_frame, frames.end_effectors[0]), speeds)
    print(HELP)
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal)  # keys come at once
        _loop(teleop, terminal)
    except KeyboardInterrupt:
        pass
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
        teleop.stop()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _loop(teleop: Teleop, terminal: int) -> None:
    while True:
        if select.select([terminal], [], [], PERIOD)[0]:
            keys = os.read(terminal, 64).decode(errors="ignore")
            if "x" in keys or not keys:  # none: the terminal has gone
                return
            for key in keys:
                if told := teleop.press(key, time.monotonic()):
                    print(told)
        teleop.tick(time.monotonic())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return the exit code."""
    return run_tool("teleop", lambda: _run(_parse(arguments)))


if __name__ == "__main__":
    sys.exit(main())
