# SPDX-License-Identifier: Apache-2.0
"""Topics and services of the controller node that no other package needs."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from viability_bounds_pkg.ros.runtime import GOAL_QOS, LATCHED_QOS, STATUS_QOS
from viability_bounds_pkg.ros.topics import USER, OfferedService, Topic

_NODE = "controller_node"

TARGET_POSE = Topic(
    "target_pose",
    PoseStamped,
    GOAL_QOS,
    (USER, "scenario_node", "viewer_node"),
    (_NODE, "viewer_node"),
    "end-effector goal in `base_frame`",
)
TARGET_POSE_SECOND = Topic(
    "target_pose_second",
    PoseStamped,
    GOAL_QOS,
    (USER,),
    (_NODE,),
    "goal of the second end effector, where `end_effector_frame` names two",
)
TARGET_POSTURE = Topic(
    "target_posture",
    JointState,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "joint goal, matched by name, rad",
)
TARGET_TRAJECTORY = Topic(
    "target_trajectory",
    MultiDOFJointTrajectory,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "poses of the end effector over time, in `base_frame`; one transform in each point",
)
TARGET_JOINT_TRAJECTORY = Topic(
    "target_joint_trajectory",
    JointTrajectory,
    GOAL_QOS,
    (USER, "moveit_node"),
    (_NODE,),
    "positions of all joints over time, rad, matched by name; replaces a pose goal; without "
    "points: stop",
)
JOG_HAND = Topic(
    "jog_hand",
    TwistStamped,
    GOAL_QOS,
    (USER,),
    (_NODE,),
    "twist of the end effector, m/s and rad/s, valid for 0.25 s; axes of `base_frame` (or "
    "empty) or of the end effector",
)
JOG_JOINTS = Topic(
    "jog_joints",
    JointState,
    GOAL_QOS,
    (USER,),
    (_NODE,),
    "`velocity` of some joints, rad/s, valid for 0.25 s; replaces a pose goal",
)
TARGET_WRENCH = Topic(
    "target_wrench",
    WrenchStamped,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "wrench that the hand exerts in `force_directions`, N and N m; axes of the end effector (or"
    " empty) or of `base_frame`",
)
ROS2_CONTROL_EFFORTS = Topic(
    "<ros2_control_topic>",
    Float64MultiArray,
    QoSProfile(depth=1),
    (_NODE,),
    (USER,),
    "efforts of `joint_commands` in the order of `joints`, for effort controllers of "
    "ros2_control; silent in position control",
)
HAND_POSE = Topic(
    "hand_pose",
    PoseStamped,
    STATUS_QOS,
    (_NODE,),
    (USER,),
    "pose of the end effector in `base_frame`, 20 times a second",
)
CONTROLLER_MODE = Topic(
    "controller_mode",
    String,
    LATCHED_QOS,
    (_NODE,),
    ("moveit_node", USER),
    "TRACKING, HOLD, POSITION or STOPPED, at each change",
)
ENABLE_TORQUE = OfferedService(
    "enable_torque",
    SetBool,
    _NODE,
    "true: from position to torque control without a torque step; false: back",
)
TARE_FT_SENSOR = OfferedService(
    "tare_ft_sensor",
    Trigger,
    _NODE,
    "sets the sensor's bias to the present measurement; call it with the hand free",
)
