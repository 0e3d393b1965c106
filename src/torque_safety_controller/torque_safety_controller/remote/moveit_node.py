# SPDX-License-Identifier: Apache-2.0
"""The MoveIt node: the action FollowJointTrajectory in, joint trajectories for the controller out.

It needs the package control_msgs.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from torque_safety_controller.driving.trajectory import TrajectoryPassed
from torque_safety_controller.node.goal_messages import (
    GoalRefused,
    check_stamp,
    joint_trajectory_from_message,
)
from torque_safety_controller.node.topics import (
    CONTROLLER_MODE,
    TARGET_JOINT_TRAJECTORY,
)
from torque_safety_controller.parameters.controller_parameters import GOAL_AHEAD_MAX
from torque_safety_controller.remote.execution import Execution, Progress, Tolerances
from torque_safety_controller.remote.moveit_parameters import MoveitConfiguration
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import JointStateReader
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.runtime import is_subscribed, set_stamp, stamp_to_ns, steady_timer
from viability_bounds_pkg.ros.topics import SLOW_JOINT_STATES
from viability_bounds_pkg.state import State

Result = FollowJointTrajectory.Result
Feedback = FollowJointTrajectory.Feedback

PERIOD = 0.05
"""Between two judgements of the arm, s."""
_SILENT = 1.0
"""How long the joint states may be silent while the arm follows a trajectory, s."""
_CONNECTING = 5.0
"""How long the controller may take to listen, s."""
_LEAVING = Duration(seconds=0.5)
"""How long what was published last may take to arrive."""

_ENDS = {
    Progress.REACHED: Result.SUCCESSFUL,
    Progress.OFF_PATH: Result.PATH_TOLERANCE_VIOLATED,
    Progress.NOT_REACHED: Result.GOAL_TOLERANCE_VIOLATED,
}


class Refused(GoalRefused):
    """A goal of the action that cannot be followed; `code` is that of the action's result."""

    def __init__(self, text: str, code: int = Result.INVALID_GOAL) -> None:
        super().__init__(text)
        self.code = code


def tolerances_from_message(
    given: Sequence[JointTolerance], joints: Sequence[str], default: float
) -> Tolerances:
    """Return the tolerances that a goal asks for: 0 stands for the default, -1 for none.

    Args:
        given: of some of the joints.
        joints: names of the n joints.
        default: of positions, rad; velocities have none.

    Raises:
        GoalRefused: an unknown joint, numbers that are no tolerances, or one of acceleration,
            which is not measured.
    """
    n = len(joints)
    parts = {"position": np.full(n, default), "velocity": np.full(n, math.inf)}
    for tolerance in given:
        if tolerance.name not in joints:
            raise Refused(f"tolerance of unknown joint '{tolerance.name}'", Result.INVALID_JOINTS)
        if tolerance.acceleration not in (0.0, -1.0):
            raise Refused(f"{tolerance.name}: tolerance of acceleration; allowed: 0 or -1")
        for name, part in parts.items():
            value = getattr(tolerance, name)
            if not (value >= 0.0 or value == -1.0):
                raise Refused(f"{tolerance.name}: tolerance {value:g}; allowed: 0, above, or -1")
            if value:
                part[joints.index(tolerance.name)] = value if value > 0.0 else math.inf
    return Tolerances(**parts)


@dataclass(eq=False)
class _Run:
    """A goal of the action that has been accepted."""

    handle: ServerGoalHandle
    execution: Execution | None
    ended: Future = field(default_factory=Future)
    result: Any = field(default_factory=Result)
    accepted: float = field(default_factory=time.monotonic)
    sent: bool = False
    moves: bool = False
    """Whether the arm moves by it, or still by the one before."""


class _Outlet:
    """The topic of trajectories; published only during a goal, so that others may otherwise."""

    def __init__(self, node: ArmNode) -> None:
        self._node = node
        self._publisher: Publisher | None = None

    @property
    def ready(self) -> bool:
        """Whether a controller listens; the first question begins to publish."""
        if self._publisher is None:
            self._publisher = TARGET_JOINT_TRAJECTORY.publisher(self._node)
        return is_subscribed(self._node, TARGET_JOINT_TRAJECTORY.name, "controller_node")

    @property
    def others(self) -> bool:
        """Whether another node publishes it."""
        count = self._node.count_publishers(TARGET_JOINT_TRAJECTORY.name)
        return count > (self._publisher is not None)

    def publish(self, message: JointTrajectory) -> None:
        """Publish to those who listen."""
        if self.ready and self._publisher is not None:
            self._publisher.publish(message)

    def close(self) -> None:
        """Publish no more, after what was published has arrived."""
        if self._publisher is not None:
            self._publisher.wait_for_all_acked(_LEAVING)
            self._node.destroy_publisher(self._publisher)
            self._publisher = None


class MoveitNode(ArmNode):
    """Offers the action FollowJointTrajectory, as MoveIt sends it.

    A process of its own beside the controller, whose control steps it does not delay. The last
    goal counts: an older one is aborted. What is asked for is checked as the controller checks
    it, and a goal that cannot be followed is aborted with the reason in its result.
    """

    NAME = "moveit_node"
    PARAMETERS = MoveitConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        self._runs: dict[bytes, _Run] = {}
        self._run: _Run | None = None
        self._trajectories = _Outlet(self)
        self._mode = ""
        self._server: ActionServer | None = None
        with self.starting():
            self._config = NodeParameters(self, MoveitConfiguration).configuration
        self._reader = JointStateReader(self._config.joints, continuous=self._config.continuous)
        SLOW_JOINT_STATES.subscription(self, self._on_state)
        CONTROLLER_MODE.subscription(self, self._on_mode)
        self._server = ActionServer(
            self,
            FollowJointTrajectory,
            "~/follow_joint_trajectory",
            self._answer,
            handle_accepted_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        steady_timer(self, PERIOD, self._tick)
        self.get_logger().info(f"action in {self.get_fully_qualified_name()}")

    def destroy_node(self) -> None:
        """Stop what the arm was sent to do."""
        if self._run is not None:
            self._end(self._run, Result.INVALID_GOAL, "moveit_node ends")
        self._trajectories.close()
        if self._server is not None:
            self._server.destroy()  # else it would stay in the ROS graph
        super().destroy_node()

    # Goals

    def _accept(self, handle: ServerGoalHandle) -> None:
        """Start a goal, in place of the one before."""
        run = self._runs[_identity(handle)] = _Run(handle, None)
        try:
            run.execution = self._execution(handle.request)
        except GoalRefused as error:  # the one before goes on
            code = error.code if isinstance(error, Refused) else Result.INVALID_GOAL
            self._end(run, code, str(error))
        else:
            if self._run is not None:
                run.moves = self._run.moves
                self._end(self._run, Result.INVALID_GOAL, "a newer goal has come", stop=False)
            self._run = run
        handle.execute()

    def _execution(self, goal: Any) -> Execution:
        config, message = self._config, goal.trajectory
        joints = list(config.joints)
        if sorted(message.joint_names) != sorted(joints):
            raise Refused(
                f"joint_names is {list(message.joint_names)}; allowed: {joints} in any order",
                Result.INVALID_JOINTS,
            )
        if goal.multi_dof_trajectory.points:
            raise Refused("multi_dof_trajectory is given; allowed: trajectory")
        if goal.component_path_tolerance or goal.component_goal_tolerance:
            raise Refused("tolerances of components are given; allowed: those of joints")
        trajectory = joint_trajectory_from_message(message, config)
        path = tolerances_from_message(goal.path_tolerance, joints, math.inf)
        near = config.trajectory_goal_tolerance
        end = tolerances_from_message(goal.goal_tolerance, joints, near)
        patience = 1e-9 * stamp_to_ns(goal.goal_time_tolerance)
        if patience < 0.0:
            raise Refused(f"goal_time_tolerance is {patience:g} s; allowed: 0 or more")
        patience = patience or config.trajectory_goal_time
        begin = stamp_to_ns(message.header.stamp)
        check_stamp(begin, self._reader.stamp, GOAL_AHEAD_MAX)
        if begin:
            try:
                late = 1e-9 * (self._reader.stamp - begin)
                trajectory.check_late(late, self._state(), config.continuous)
            except TrajectoryPassed as error:
                raise Refused(str(error), Result.OLD_HEADER_TIMESTAMP) from error
        return Execution(joints, trajectory, path, end, patience, begin, config.continuous)

    async def _answer(self, handle: ServerGoalHandle) -> Any:
        """Return the result of a goal when it has ended."""
        run = self._runs[_identity(handle)]
        await run.ended
        del self._runs[_identity(handle)]
        result = run.result
        if handle.is_cancel_requested:
            handle.canceled()
        elif result.error_code == Result.SUCCESSFUL:
            handle.succeed()
        else:
            handle.abort()
        return result

    def _end(self, run: _Run, code: int, text: str = "", *, stop: bool = True) -> None:
        """End a goal; `stop` lets the arm come to rest unless it is where it was to go."""
        run.result.error_code, run.result.error_string = code, text
        if run is self._run:
            self._run = None
            if code != Result.SUCCESSFUL and run.moves and stop:
                self._trajectories.publish(JointTrajectory(joint_names=list(self._config.joints)))
            if stop:
                self._trajectories.close()
        if text:
            self.get_logger().warning(f"follow_joint_trajectory ended: {text}")
        else:
            self.get_logger().info("follow_joint_trajectory: reached")
        run.ended.set_result(None)

    def _tick(self) -> None:
        """Send or judge the goal."""
        now, run = time.monotonic(), self._run
        if run is None or run.execution is None:
            return
        if run.handle.is_cancel_requested:
            self._end(run, Result.INVALID_GOAL, "canceled")
        elif not run.sent:
            self._send(run, run.execution, now)
        elif now - self._reader.heard_at > _SILENT:
            self._end(run, Result.PATH_TOLERANCE_VIOLATED, "the joint states are silent")
        elif not self._trajectories.ready:
            self._end(run, Result.PATH_TOLERANCE_VIOLATED, "the controller has gone")
        elif self._mode in ("STOPPED", "POSITION"):
            text = f"the controller's mode is {self._mode}; /diagnostics tell why"
            self._end(run, Result.PATH_TOLERANCE_VIOLATED, text)
        else:
            self._judge(run, run.execution)

    def _send(self, run: _Run, execution: Execution, now: float) -> None:
        heard = now - self._reader.heard_at < _SILENT
        if self._trajectories.others:
            name = self.resolve_topic_name(TARGET_JOINT_TRAJECTORY.name)
            self._end(run, Result.INVALID_GOAL, f"another node publishes '{name}'")
        elif self._trajectories.ready and heard:
            self._trajectories.publish(run.handle.request.trajectory)
            run.sent = run.moves = True
            ago = round(1e9 * (now - self._reader.heard_at))
            execution.start(self._state(), self._reader.stamp + ago)
        elif now - run.accepted > _CONNECTING:
            missing = "no controller is heard" if heard else "no joint states are heard"
            self._end(run, Result.INVALID_GOAL, f"{missing} for {_CONNECTING:g} s")

    def _judge(self, run: _Run, execution: Execution) -> None:
        """Compare the arm with the trajectory, and tell the client."""
        state, stamp = self._state(), self._reader.stamp
        progress = execution.judge(state, stamp)
        feedback = Feedback(joint_names=list(self._config.joints))
        set_stamp(feedback.header.stamp, stamp)
        q, v, a = execution.desired
        feedback.desired = _point(q, v, a)
        feedback.actual = _point(state.q, state.v)
        feedback.error = _point(*execution.off)
        set_stamp(feedback.desired.time_from_start, max(0, stamp - execution.begin))
        run.handle.publish_feedback(feedback)
        if progress is not Progress.MOVING:
            text = execution.why
            if text and self._mode != "TRACKING":
                text += f"; the controller's mode is {self._mode}"
            self._end(run, _ENDS[progress], text)

    def _state(self) -> State:
        return State(self._reader.q, self._reader.v)

    # Messages

    def _on_state(self, message: JointState) -> None:
        self._reader.read(message, time.monotonic())

    def _on_mode(self, message: String) -> None:
        self._mode = message.data


def _identity(handle: ServerGoalHandle) -> bytes:
    return bytes(handle.goal_id.uuid)


def _point(q: np.ndarray, v: np.ndarray, a: np.ndarray | None = None) -> JointTrajectoryPoint:
    point = JointTrajectoryPoint(positions=q.tolist(), velocities=v.tolist())
    if a is not None:
        point.accelerations = a.tolist()
    return point


def main(args: list[str] | None = None) -> int:
    """Run the MoveIt node until it is told to stop."""
    return run(MoveitNode, args)


if __name__ == "__main__":
    sys.exit(main())
