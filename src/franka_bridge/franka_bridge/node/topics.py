# SPDX-License-Identifier: Apache-2.0
"""Topics and services of the robot's node that no other package needs."""

from __future__ import annotations

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from viability_bounds_pkg.ros.runtime import CONTROL_QOS
from viability_bounds_pkg.ros.topics import USER, OfferedService, Topic

_NODE = "franka_node"

EXTERNAL_TORQUES = Topic(
    "external_torques",
    JointState,
    CONTROL_QOS,
    (_NODE,),
    (USER,),
    "`effort` is libfranka's `tau_ext_hat_filtered`, N m",
)
EXTERNAL_WRENCH_ESTIMATE = Topic(
    "external_wrench_estimate",
    WrenchStamped,
    CONTROL_QOS,
    (_NODE,),
    (USER,),
    "libfranka's `O_F_ext_hat_K`, in the axes of the robot's base, N and N m",
)
RECOVER = OfferedService(
    "recover",
    Trigger,
    _NODE,
    "resets the robot's errors, or connects again, and begins torque control: the arm is held; a "
    "robot that does not know its load is told it first, at rest",
)
