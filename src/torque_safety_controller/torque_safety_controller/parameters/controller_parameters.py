"""The controller node's parameters: the table, and what the node is made of from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from torque_safety_controller.additional_torque import AdditionalSettings
from torque_safety_controller.contact.interaction import InteractionSettings
from torque_safety_controller.contact.wrench_sensor import SensorSettings
from torque_safety_controller.parameters import (
    collision_parameters,
    friction_parameters,
    integral_parameters,
    interaction_parameters,
)
from torque_safety_controller.qp.inverse_dynamics_qp import SOLVERS
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.safety.modes import CONTROLS
from torque_safety_controller.tasks.gains import Gains, critical_damping
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError
from viability_bounds_pkg.ros.parameters import (
    Parameter,
    joint_names,
    per_joint,
    positive,
)
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    all_positive,
    model_from,
    position_limits,
    robot_urdf,
)

if TYPE_CHECKING:
    from rclpy.node import Node

TABLE = (
    *ROBOT_TABLE,
    Parameter("base_frame", str, "frame of pose goals; fixed to the URDF's root"),
    Parameter("end_effector_frame", str, "frame that pose goals move"),
    Parameter(
        "torque_rate_max",
        list[float],
        "limits of the rate of torque, N m/s; none if empty",
        default=np.zeros(0),
    ),
    Parameter("rate_hz", float, "rate of the control loop, Hz"),
    Parameter("pose_kp", float, "stiffness of the pose task, 1/s^2", live=True),
    Parameter("pose_kd", float, "its damping, 1/s; -1: critical", default=-1.0, live=True),
    Parameter("pose_weight", float, "its weight; 0: no pose task", default=1.0, live=True),
    Parameter("posture_kp", float, "stiffness of the posture task, 1/s^2", live=True),
    Parameter("posture_kd", float, "its damping, 1/s; -1: critical", default=-1.0, live=True),
    Parameter("posture_weight", float, "its weight, > 0", default=1e-3, live=True),
    Parameter(
        "posture_in_null_space",
        bool,
        "whether the posture task leaves the pose alone; false: eq. (33) as printed",
        default=True,
        live=True,
    ),
    Parameter("hold_kd", float, "damping in HOLD, 1/s", default=20.0, live=True),
    Parameter(
        "qp_solver",
        str,
        f"one of {', '.join(SOLVERS)}; proxqp takes several times as long",
        default="daqp",
    ),
    Parameter(
        "disturbance_time",
        float,
        "time constant with which what disturbs the accelerations is learned and kept out of "
        "the bounds, s; -1: not at all",
        default=-1.0,
        live=True,
    ),
    *integral_parameters.TABLE,
    *friction_parameters.TABLE,
    *interaction_parameters.TABLE,
    *collision_parameters.TABLE,
    Parameter(
        "start_control",
        str,
        f"one of {', '.join(CONTROLS)}: what the robot is commanded by until enable_torque is "
        "called",
        default="torque",
    ),
    Parameter(
        "bounds_timeout",
        float,
        "how long a state waits for its acceleration limits, or a usable state for another, "
        "before HOLD, s",
        default=0.05,
    ),
    Parameter(
        "state_timeout",
        float,
        "how long without a usable joint state before STOPPED, s",
        default=0.5,
    ),
    Parameter("goal_timeout", float, "age of a goal before HOLD, s; 0: never", default=0.0),
    Parameter(
        "ros2_control_topic",
        str,
        "where to publish efforts as std_msgs/Float64MultiArray too; empty: nowhere",
        default="",
    ),
)


@dataclass(frozen=True)
class ControllerConfiguration:
    """Checked parameters of the controller node; arrays of shape (n,) in `joints` order."""

    joints: tuple[str, ...]
    dt: float
    q_min: np.ndarray
    q_max: np.ndarray
    tau_max: np.ndarray
    tau_rate_max: np.ndarray
    base_frame: str
    end_effector_frame: str
    gains: Gains
    qp_solver: str
    additional: AdditionalSettings
    task_rows: slice
    ft_frame: str
    sensor: SensorSettings
    interaction: InteractionSettings
    collision: collision_parameters.CollisionConfiguration | None
    start_control: str
    bounds_timeout: float
    state_timeout: float
    goal_timeout: float
    ros2_control_topic: str


def make_configuration(values: Mapping[str, Any]) -> ControllerConfiguration:
    """Check everything but the URDF, which `load_robot` reads once.

    Raises:
        SettingError: a value cannot be used.
    """
    joints = joint_names(values)
    tau_rate_max = np.full(len(joints), np.inf)
    if len(values["torque_rate_max"]):
        tau_rate_max = per_joint(values, "torque_rate_max", joints)
        if not (tau_rate_max > 0).all():
            raise SettingError("torque_rate_max", tau_rate_max, "numbers > 0")
    q_min, q_max = position_limits(values, joints)
    tau_max = all_positive(values, "torque_max", joints)
    if values["qp_solver"] not in SOLVERS:
        raise SettingError("qp_solver", values["qp_solver"], f"one of {', '.join(SOLVERS)}")
    if values["start_control"] not in CONTROLS:
        allowed = f"one of {', '.join(CONTROLS)}"
        raise SettingError("start_control", values["start_control"], allowed)
    return ControllerConfiguration(
        joints=joints,
        dt=1.0 / positive(values, "rate_hz"),
        q_min=q_min,
        q_max=q_max,
        tau_max=tau_max,
        tau_rate_max=tau_rate_max,
        base_frame=values["base_frame"],
        end_effector_frame=values["end_effector_frame"],
        gains=_gains(values),
        qp_solver=values["qp_solver"],
        additional=integral_parameters.additional_settings(values, joints, tau_max),
        task_rows=integral_parameters.task_rows(values),
        ft_frame=values["ft_frame"],
        sensor=interaction_parameters.sensor_settings(values),
        interaction=interaction_parameters.interaction_settings(values),
        collision=collision_parameters.collision_configuration(values, joints, q_min, q_max),
        start_control=values["start_control"],
        bounds_timeout=positive(values, "bounds_timeout"),
        state_timeout=positive(values, "state_timeout"),
        goal_timeout=positive(values, "goal_timeout", zero=True),
        ros2_control_topic=values["ros2_control_topic"],
    )


def _gains(values: Mapping[str, Any]) -> Gains:
    gains = {
        name: positive(values, name, zero=name != "posture_weight")
        for name in ("pose_kp", "pose_weight", "posture_kp", "posture_weight", "hold_kd")
    }
    for task in ("pose", "posture"):
        name = f"{task}_kd"
        kd = values[name]
        gains[name] = (
            critical_damping(gains[f"{task}_kp"]) if kd == -1.0 else positive(values, name)
        )
    time = values["disturbance_time"]
    if time == -1.0:
        gains["disturbance_time"] = None
    else:
        gains["disturbance_time"] = positive(values, "disturbance_time", zero=True)
    return Gains(**gains, posture_in_null_space=values["posture_in_null_space"])


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


def load_robot(values: Mapping[str, Any], node: Node | None) -> LoadedRobot:
    """Read the URDF, once, and return what is made of it.

    Args:
        values: parameter values by name.
        node: listens for the URDF if it comes from a topic.

    Raises:
        SettingError: a URDF that does not load, or a joint or frame that it does not have.
    """
    urdf = robot_urdf(values, node)
    model = model_from(values, urdf)
    return LoadedRobot(
        _with_frame(model, values, "end_effector_frame"),
        _base_placement(model, values["base_frame"]),
        urdf,
    )


def _with_frame(model: pin.Model, values: Mapping[str, Any], name: str) -> RobotModel:
    frame = values[name]
    try:
        return RobotModel(model, frame, 1.0 / values["rate_hz"])
    except RobotDescriptionError as error:
        raise SettingError(name, frame, f"a frame of the URDF ({error})") from error


def _base_placement(model: pin.Model, frame: str) -> pin.SE3:
    if not model.existFrame(frame):
        known = ", ".join(f.name for f in model.frames if f.parentJoint == 0)
        raise SettingError("base_frame", frame, f"a frame fixed to the root: {known}")
    found = model.frames[model.getFrameId(frame)]
    if found.parentJoint != 0:
        raise SettingError("base_frame", frame, "a frame fixed to the root, not a moving one")
    return found.placement
