# SPDX-License-Identifier: Apache-2.0
"""Topics and services of the robot node that no other package needs."""

from __future__ import annotations

from geometry_msgs.msg import WrenchStamped
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from viability_bounds_pkg.ros.runtime import CONTROL_QOS, GOAL_QOS, NEWEST_QOS
from viability_bounds_pkg.ros.topics import USER, OfferedService, Topic

_NODE = "bullet_node"

OBSTACLES = Topic(
    "obstacles",
    MarkerArray,
    GOAL_QOS,
    (USER, "scenario_node"),
    (_NODE,),
    "simulated obstacles that the controller does not know: boxes, spheres, cylinders",
)
EXTERNAL_WRENCH = Topic(
    "external_wrench",
    WrenchStamped,
    GOAL_QOS,
    (USER, "scenario_node", "viewer_node"),
    (_NODE, "simulated_fr3"),
    "push on the link `frame_id` at its origin, in world axes, N and N m",
)
CLOCK = Topic(
    "/clock",
    Clock,
    CONTROL_QOS,
    (_NODE,),
    (USER,),
    "robot time; only with `publish_clock`",
)
RECORDED = Topic(
    "recorded",
    Header,
    NEWEST_QOS,
    ("scenario_node",),
    (_NODE,),
    "stamp of a state that is recorded; in lockstep the robot begins no period that is more than "
    "20 later",
)
RESET = OfferedService(
    "reset", Trigger, _NODE, "puts the robot at its start configuration, at rest"
)
PAUSE = OfferedService("pause", SetBool, _NODE, "stops robot time (true) or lets it go on (false)")
