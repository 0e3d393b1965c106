# SPDX-License-Identifier: Apache-2.0
"""The controller node's parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import FrictionSettings
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.modes import CONTROLS
from torque_safety_controller.parameters.collision_parameters import CollisionConfiguration
from torque_safety_controller.parameters.friction_parameters import FrictionConfiguration
from torque_safety_controller.parameters.integral_parameters import IntegralConfiguration
from torque_safety_controller.parameters.interaction_parameters import InteractionConfiguration
from torque_safety_controller.parts.whole_arm.braking_plan import RESERVE
from torque_safety_controller.qp import SOLVERS
from torque_safety_controller.settings import Settings
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    POSITIVE,
    Range,
    group,
    joint_amounts,
    joint_numbers,
    number,
    switch,
    text,
    timeout,
)
from viability_bounds_pkg.robot.configuration import (
    ControlRate,
    RobotConfiguration,
    StateSource,
    TaskFrames,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class ControllerConfiguration(StateSource, ControlRate, TaskFrames, RobotConfiguration):
    """Parameters of the controller node; arrays of shape (n,) in `joints` order.

    Attributes:
        integral_settings: of the integral action.
        friction_settings: of the friction compensation.
    """

    NOT_NEEDED = frozenset({"velocity_max"})

    velocity_max: Array = joint_numbers(
        "speed limits, rad/s, for driving, and HOLD without bounds; those of the URDF if empty, "
        "or none",
        POSITIVE,
        default=(),
    )
    torque_rate_max: Array = joint_numbers(
        "limits of the rate of torque, N m/s; torques are clipped to them, and other limits not "
        "promised then; none if empty",
        if_empty=np.inf,
        note="all > 0",
    )
    gains: Gains = group(Gains)
    safety_filter: bool = switch(
        "whether steps are changed after which no plan is known that brings the arm to rest "
        "within all limits; acceleration_min and acceleration_max need not be available in every "
        "state then",
        default=False,
    )
    torque_reserve: Array = joint_amounts(
        "torque that safety_filter leaves unplanned, for pushes, payloads and errors of the "
        "motors, which no model knows, N m; none if empty",
        note="less than 0.97 of torque_max",
    )
    qp_solver: str = text(
        "solver of the QP; proxqp takes several times as long",
        default="daqp",
        choices=tuple(SOLVERS),
    )
    integral: IntegralConfiguration = group(IntegralConfiguration)
    friction: FrictionConfiguration = group(FrictionConfiguration)
    interaction: InteractionConfiguration = group(InteractionConfiguration)
    collision: CollisionConfiguration = group(CollisionConfiguration)
    start_control: str = text(
        "what the robot is commanded by until enable_torque is called",
        default="torque",
        choices=CONTROLS,
    )
    bounds_timeout: float = timeout(
        "how long a state waits for its acceleration limits before HOLD, s; without a joint state "
        "for 1.5 times as long: STOPPED",
        default=0.05,
    )
    state_timeout: float = timeout(
        "how long without a usable joint state until the arm may be elsewhere and all begins anew "
        "with the next one, s",
        default=0.5,
    )
    goal_timeout: float = number(
        "age of a goal before HOLD, s; 0: never", Range(0.0, 1e5), default=0.0
    )
    effort_tolerance: float = number(
        "by how much torques of joint states may differ from those that were commanded, share of "
        "torque_max; beyond, commands count as not acting, and the arm is slowed; 0: not compared",
        Range(0.0, 2.0),
        default=0.03,
    )
    ros2_control_topic: str = text(
        "where to publish efforts as std_msgs/Float64MultiArray too; empty: nowhere", default=""
    )
    integral_settings: IntegralSettings = field(init=False)
    friction_settings: FrictionSettings = field(init=False)

    @property
    def settings(self) -> Settings:
        """What may change while the controller runs."""
        return Settings(
            self.gains,
            self.integral.integral_action,
            self.integral_settings,
            self.friction_settings,
            self.interaction.settings,
            self.interaction.sensor,
        )

    @property
    def clips_torque_rates(self) -> bool:
        """Whether torques are clipped to rates, so that no other limit is promised."""
        return bool(np.isfinite(self.torque_rate_max).any())

    def __post_init__(self) -> None:
        """Check all that does not depend on the URDF, and make the settings."""
        super().__post_init__()
        if not len(self.velocity_max):
            object.__setattr__(self, "velocity_max", np.full(len(self.joints), np.inf))
        if not (self.torque_rate_max > 0).all():
            raise SettingError("torque_rate_max", self.torque_rate_max, "numbers > 0")
        if not (self.torque_reserve < (1.0 - RESERVE) * self.torque_max).all():
            allowed = f"less than {1.0 - RESERVE:g} of torque_max"
            raise SettingError("torque_reserve", self.torque_reserve, allowed)
        integral = self.integral.settings(self.torque_max, len(self.end_effectors))
        object.__setattr__(self, "integral_settings", integral)
        object.__setattr__(self, "friction_settings", self.friction.settings(self.torque_max))
        self.collision.check(self)
        if self.safety_filter:
            self.collision.check_accelerations(self)
