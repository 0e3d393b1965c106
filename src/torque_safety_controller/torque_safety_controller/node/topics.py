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
    "end-effector goal in `base_frame`; a stamp in the future takes effect then",
)
TARGET_POSE_SECOND = Topic(
    "target_pose_second",
    PoseStamped,
    GOAL_QOS,
    (USER,),
    (_NODE,),
    "goal of the second end effector, where `end_effector_frame` names two; else as `target_pose`",
)
TARGET_POSTURE = Topic(
    "target_posture",
    JointState,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "joint goal, matched by name, rad; a stamp in the future takes effect then",
)
TARGET_TRAJECTORY = Topic(
    "target_trajectory",
    MultiDOFJointTrajectory,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "poses of the end effector over time, with velocities and accelerations to feed forward, in "
    "`base_frame`; one transform in each point",
)
TARGET_WRENCH = Topic(
    "target_wrench",
    WrenchStamped,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "wrench that the hand exerts in `force_directions`, N and N m; axes of the end effector (or "
    "empty) or of `base_frame`",
)
TARGET_JOINT_TRAJECTORY = Topic(
    "target_joint_trajectory",
    JointTrajectory,
    GOAL_QOS,
    (USER, "moveit_node"),
    (_NODE,),
    "positions of all joints over time, rad, perhaps with velocities and accelerations, matched "
    "by name; a goal for the pose is given up; without points: the joints come to rest",
)
JOG_HAND = Topic(
    "jog_hand",
    TwistStamped,
    GOAL_QOS,
    (USER,),
    (_NODE,),
    "twist of the end effector for at most 0.25 s, m/s and rad/s, in the axes of `base_frame` (or "
    "empty) or of the end effector",
)
JOG_JOINTS = Topic(
    "jog_joints",
    JointState,
    GOAL_QOS,
    (USER,),
    (_NODE,),
    "`velocity` of the joints named for at most 0.25 s, rad/s, of the others 0; no `position`; a "
    "goal for the pose is given up",
)
ROS2_CONTROL_EFFORTS = Topic(
    "<ros2_control_topic>",
    Float64MultiArray,
    QoSProfile(depth=1),
    (_NODE,),
    (USER,),
    "the efforts of `joint_commands` in `joints` order, for effort controllers of ros2_control; "
    "the parameter `ros2_control_topic` names the topic; silent in position control; reliable, "
    "as those controllers may ask for",
)
HAND_POSE = Topic(
    "hand_pose",
    PoseStamped,
    STATUS_QOS,
    (_NODE,),
    (USER,),
    "pose of the end effector in `base_frame`, 20 times a second unless the mode is STOPPED; "
    "stamp of the joint state",
)
CONTROLLER_MODE = Topic(
    "controller_mode",
    String,
    LATCHED_QOS,
    (_NODE,),
    ("moveit_node", USER),
    "TRACKING, HOLD, POSITION or STOPPED, when it changes; the reasons are in `/diagnostics`",
)
GOALS = (
    TARGET_POSE,
    TARGET_POSE_SECOND,
    TARGET_POSTURE,
    TARGET_TRAJECTORY,
    TARGET_JOINT_TRAJECTORY,
    JOG_HAND,
    JOG_JOINTS,
    TARGET_WRENCH,
)
"""What the arm obeys from one node each."""

TOPICS = (
    *GOALS,
    ROS2_CONTROL_EFFORTS,
    HAND_POSE,
    CONTROLLER_MODE,
)

ENABLE_TORQUE = OfferedService(
    "enable_torque",
    SetBool,
    _NODE,
    "hands over from position to torque control without a step in torque (true), and back "
    "(false), or says why not",
)
TARE_FT_SENSOR = OfferedService(
    "tare_ft_sensor",
    Trigger,
    _NODE,
    "takes the present measurement as the sensor's bias; call it with the hand free; only where "
    "`ft_frame` is set",
)
SERVICES = (ENABLE_TORQUE, TARE_FT_SENSOR)
