# SPDX-License-Identifier: Apache-2.0
"""The controller node's parameters: the table, and what the node is made of from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.additional_torque import AdditionalSettings
from torque_safety_controller.parameters.collision_parameters import (
    COLLISION_TABLE,
    CollisionConfiguration,
    collision_configuration,
)
from torque_safety_controller.parameters.friction_parameters import FRICTION_TABLE
from torque_safety_controller.parameters.integral_parameters import (
    INTEGRAL_TABLE,
    additional_settings,
    task_rows,
)
from torque_safety_controller.parameters.interaction_parameters import (
    INTERACTION_TABLE,
    InteractionConfiguration,
    interaction_configuration,
)
from torque_safety_controller.qp.inverse_dynamics_qp import SOLVERS
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.safety.modes import CONTROLS
from torque_safety_controller.tasks.gains import Gains, critical_damping
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError
from viability_bounds_pkg.ros.parameters import Parameter, Range, above, given_or
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    RobotConfiguration,
    load_model,
    position_limits,
    robot_configuration,
    robot_urdf,
)

if TYPE_CHECKING:
    from rclpy.node import Node

Array = NDArray[np.float64]

CRITICAL = -1.0
"""Of ``pose_kd`` and ``posture_kd``: critical damping."""

OFF = -1.0
"""Of ``disturbance_time``: disturbances are not estimated."""

TABLE = (
    *ROBOT_TABLE,
    Parameter("base_frame", str, "frame of pose goals; fixed to the URDF's root"),
    Parameter("end_effector_frame", str, "frame that pose goals move"),
    Parameter(
        "torque_rate_max",
        list[float],
        "limits of the rate of torque, N m/s; none if empty",
        default=np.zeros(0),
        per_joint=True,
        note="all > 0",
    ),
    Parameter("rate_hz", float, "rate of the control loop, Hz", within=above(0.0, 1e4)),
    Parameter(
        "pose_kp", float, "stiffness of the pose task, 1/s^2", live=True, within=Range(0.0, 1e5)
    ),
    Parameter(
        "pose_kd",
        float,
        "damping of the pose task, 1/s; -1: critical, 2 sqrt(kp)",
        default=CRITICAL,
        live=True,
        within=above(0.0, 1e4, special=CRITICAL),
    ),
    Parameter(
        "pose_weight",
        float,
        "weight of the pose task; 0: no pose task",
        default=1.0,
        live=True,
        within=Range(0.0, 1e5),
    ),
    Parameter(
        "posture_kp",
        float,
        "stiffness of the posture task, 1/s^2",
        live=True,
        within=Range(0.0, 1e5),
    ),
    Parameter(
        "posture_kd",
        float,
        "damping of the posture task, 1/s; -1: critical, 2 sqrt(kp)",
        default=CRITICAL,
        live=True,
        within=above(0.0, 1e4, special=CRITICAL),
    ),
    Parameter(
        "posture_weight",
        float,
        "weight of the posture task",
        default=1e-3,
        live=True,
        within=above(0.0, 1e5),
    ),
    Parameter(
        "posture_in_null_space",
        bool,
        "whether the posture task leaves the pose alone; false: eq. (33) as printed",
        default=True,
        live=True,
    ),
    Parameter(
        "hold_kd",
        float,
        "damping in HOLD, 1/s",
        default=20.0,
        live=True,
        within=Range(0.0, 1e4),
    ),
    Parameter(
        "qp_solver",
        str,
        "solver of the QP; proxqp takes several times as long",
        default="daqp",
        choices=tuple(SOLVERS),
    ),
    Parameter(
        "disturbance_time",
        float,
        "time constant with which the error of the accelerations is estimated, to tighten the "
        "bounds by it, s; -1: not at all",
        default=OFF,
        live=True,
        within=Range(0.0, 10.0, special=OFF),
    ),
    *INTEGRAL_TABLE,
    *FRICTION_TABLE,
    *INTERACTION_TABLE,
    *COLLISION_TABLE,
    Parameter(
        "start_control",
        str,
        "what the robot is commanded by until enable_torque is called",
        default="torque",
        choices=CONTROLS,
    ),
    Parameter(
        "bounds_timeout",
        float,
        "how long a state waits for its acceleration limits, or a usable state for another, "
        "before HOLD, s",
        default=0.05,
        within=above(0.0, 3600.0),
    ),
    Parameter(
        "state_timeout",
        float,
        "how long without a usable joint state before STOPPED, s",
        default=0.5,
        within=above(0.0, 3600.0),
    ),
    Parameter(
        "goal_timeout",
        float,
        "age of a goal before HOLD, s; 0: never",
        default=0.0,
        within=Range(0.0, 1e5),
    ),
    Parameter(
        "ros2_control_topic",
        str,
        "where to publish efforts as std_msgs/Float64MultiArray too; empty: nowhere",
        default="",
    ),
)


@dataclass(frozen=True, eq=False)
class ControllerConfiguration:
    """Checked parameters of the controller node; arrays of shape (n,) in `joints` order."""

    robot: RobotConfiguration
    dt: float
    q_min: Array
    q_max: Array
    tau_max: Array
    tau_rate_max: Array
    base_frame: str
    end_effector_frame: str
    gains: Gains
    qp_solver: str
    additional: AdditionalSettings
    task_rows: slice
    interaction: InteractionConfiguration
    collision: CollisionConfiguration | None
    start_control: str
    bounds_timeout: float
    state_timeout: float
    goal_timeout: float
    ros2_control_topic: str

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the n joints."""
        return self.robot.joints


def make_configuration(values: Mapping[str, Any]) -> ControllerConfiguration:
    """Check everything but the URDF, which `load_robot` reads once.

    Args:
        values: of `TABLE`, by name, as `read_values` returns them.

    Raises:
        SettingError: values that do not fit together.
    """
    robot = robot_configuration(values)
    joints = robot.joints
    tau_rate_max = given_or(values, "torque_rate_max", np.full(len(joints), np.inf))
    if not (tau_rate_max > 0).all():
        raise SettingError("torque_rate_max", tau_rate_max, "numbers > 0")
    q_min, q_max = position_limits(values, joints)
    tau_max = values["torque_max"]
    return ControllerConfiguration(
        robot=robot,
        dt=1.0 / values["rate_hz"],
        q_min=q_min,
        q_max=q_max,
        tau_max=tau_max,
        tau_rate_max=tau_rate_max,
        base_frame=values["base_frame"],
        end_effector_frame=values["end_effector_frame"],
        gains=_gains(values),
        qp_solver=values["qp_solver"],
        additional=additional_settings(values, joints, tau_max),
        task_rows=task_rows(values),
        interaction=interaction_configuration(values),
        collision=collision_configuration(values, joints, q_min, q_max),
        start_control=values["start_control"],
        bounds_timeout=values["bounds_timeout"],
        state_timeout=values["state_timeout"],
        goal_timeout=values["goal_timeout"],
        ros2_control_topic=values["ros2_control_topic"],
    )


def _gains(values: Mapping[str, Any]) -> Gains:
    gains = {field.name: values[field.name] for field in fields(Gains) if field.name in values}
    for task in ("pose", "posture"):
        if gains[f"{task}_kd"] == CRITICAL:
            gains[f"{task}_kd"] = critical_damping(gains[f"{task}_kp"])
    if gains["disturbance_time"] == OFF:
        gains["disturbance_time"] = None
    return Gains(**gains)


class LoadedRobot(NamedTuple):
    """What the URDF says.

    Attributes:
        robot: model of the arm.
        base: placement of the base frame in the URDF's root frame.
        urdf: its text.
    """

    robot: RobotModel
    base: pin.SE3
    urdf: str


def load_robot(config: ControllerConfiguration, node: Node | None = None) -> LoadedRobot:
    """Read the URDF, once, and return what is made of it.

    Args:
        config: checked parameters.
        node: listens for the URDF if it comes from a topic.

    Raises:
        SettingError: a URDF that does not load, or a joint or frame that it does not have.
    """
    urdf = robot_urdf(config.robot.description, node)
    model = load_model(config.robot, urdf)
    frame = config.end_effector_frame
    try:
        robot = RobotModel(model, frame, config.dt)
    except RobotDescriptionError as error:
        allowed = f"a frame of the URDF ({error})"
        raise SettingError("end_effector_frame", frame, allowed) from error
    return LoadedRobot(robot, _base_placement(model, config.base_frame), urdf)


def _base_placement(model: pin.Model, frame: str) -> pin.SE3:
    if not model.existFrame(frame):
        known = ", ".join(f.name for f in model.frames if f.parentJoint == 0)
        raise SettingError("base_frame", frame, f"a frame fixed to the root: {known}")
    found = model.frames[model.getFrameId(frame)]
    if found.parentJoint != 0:
        raise SettingError("base_frame", frame, "a frame fixed to the root, not a moving one")
    return found.placement
