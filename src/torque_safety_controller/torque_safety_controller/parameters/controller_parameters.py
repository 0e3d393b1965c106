# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller node."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import (
    DEFAULT_STRIBECK_VELOCITY,
    FrictionModel,
    FrictionSettings,
)
from torque_safety_controller.integral_feedback import MODES, TASKS
from torque_safety_controller.integral_feedback.settings import METHODS, IntegralSettings
from torque_safety_controller.modes import CONTROLS
from torque_safety_controller.parameters.contact_parameters import (
    CollisionConfiguration,
    InteractionConfiguration,
)
from torque_safety_controller.parts.whole_arm.braking_plan import RESERVE
from torque_safety_controller.qp import SOLVERS
from torque_safety_controller.step import Settings
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    check_per_joint,
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
from viability_bounds_pkg.robot.gravity import TorqueConvention

Array = NDArray[np.float64]

GOAL_AHEAD_MAX = 60.0
"""Default of how far ahead a goal may be sent, s: scenarios are sent whole."""

INTEGRAL_BUDGET = 0.1
"""Default budget in torque limits: the paper's tau_m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class IntegralConfiguration:
    """Parameters of the integral action."""

    integral_action: str = text(
        "joints: all joints stiff; task, position: pose or position of the hand stiff, null "
        "space compliant",
        default="none",
        choices=MODES,
    )
    integral_budget: Array = joint_numbers(
        f"limits of the additional torque, N m; {INTEGRAL_BUDGET:g} of torque_max if empty",
        NOT_NEGATIVE,
        default=(),
        live=True,
        note="at most torque_max",
    )
    integral_lambda: float = number(
        "gain lambda, 1/s; lowered in postures where it would be unstable",
        Range(1.0, 1e3),
        default=2.0,
        live=True,
    )
    integral_anti_windup: str = text(
        "qp: limits the whole additional torque and the integrators; paper, scaling: eq. (11), "
        "(10), the laws as printed",
        default="qp",
        choices=METHODS,
    )

    def settings(self, tau_max: Array, hands: int = 1) -> IntegralSettings:
        """Return the settings of the integral action.

        Args:
            tau_max: torque limits, shape (n,), N m.
            hands: number of end effectors.

        Raises:
            SettingError: values that do not fit together.
        """
        rows = TASKS.get(self.integral_action)
        if rows is not None and hands * rows.stop >= len(tau_max):
            allowed = (
                f"'none' or 'joints': {len(tau_max)} joints have no null space left of the task"
            )
            raise SettingError("integral_action", self.integral_action, allowed)
        budget = self.integral_budget if len(self.integral_budget) else INTEGRAL_BUDGET * tau_max
        if (budget > tau_max).any():
            raise SettingError("integral_budget", budget, "at most torque_max")
        return IntegralSettings(
            budget,
            gain=self.integral_lambda,
            anti_windup=self.integral_anti_windup,
        )


FRICTION_BUDGET = 0.2
"""Largest torque that is compensated, in torque limits."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrictionConfiguration:
    """Parameters of the friction compensation; `identify_friction` finds the model."""

    friction_compensation: float = number(
        "share of the friction model that is compensated; 0: off",
        Range(0.0, 1.0),
        default=0.0,
        live=True,
    )
    friction_model_coulomb: Array = joint_numbers(
        "dry friction in motion, N m; none if empty", NOT_NEGATIVE, default=(), live=True
    )
    friction_model_static: Array = joint_numbers(
        "dry friction at rest, N m; that in motion if empty",
        NOT_NEGATIVE,
        default=(),
        live=True,
    )
    friction_model_viscous: Array = joint_numbers(
        "viscous friction, N m s/rad; none if empty",
        NOT_NEGATIVE,
        default=(),
        live=True,
    )
    friction_model_stribeck_velocity: Array = joint_numbers(
        "speed of the change from static to Coulomb friction, rad/s; "
        f"{DEFAULT_STRIBECK_VELOCITY:g} if empty",
        POSITIVE,
        if_empty=DEFAULT_STRIBECK_VELOCITY,
        live=True,
    )

    def settings(self, tau_max: Array) -> FrictionSettings:
        """Return the settings of the friction compensation.

        Args:
            tau_max: torque limits, shape (n,), N m.

        Raises:
            SettingError: values that do not fit together.
        """
        given = (
            self.friction_model_coulomb,
            self.friction_model_static,
            self.friction_model_viscous,
        )
        scale = self.friction_compensation
        if scale > 0.0 and not any(map(len, given)):
            allowed = "0 as long as no friction_model_coulomb, _static or _viscous is given"
            raise SettingError("friction_compensation", scale, allowed)
        coulomb, static, viscous = (row if len(row) else 0.0 * tau_max for row in given)
        if not len(self.friction_model_static):
            static = coulomb
        if (static < coulomb).any():
            allowed = "at least friction_model_coulomb everywhere"
            raise SettingError("friction_model_static", static, allowed)
        model = FrictionModel(coulomb, static, viscous, self.friction_model_stribeck_velocity)
        return FrictionSettings(model, FRICTION_BUDGET * tau_max, scale)


@dataclass(frozen=True, eq=False, kw_only=True)
class ControllerConfiguration(
    StateSource, ControlRate, TaskFrames, TorqueConvention, RobotConfiguration
):
    """Parameters of the controller node; arrays of shape (n,) in `joints` order.

    Attributes:
        integral_settings: of the integral action.
        friction_settings: of the friction compensation.
    """

    NOT_NEEDED = frozenset({"velocity_max"})

    velocity_max: Array = joint_numbers(
        "speed limits of jogs, trajectories and HOLD without bounds, rad/s; those of the URDF "
        "if empty, or none",
        POSITIVE,
        default=(),
    )
    torque_rate_max: Array = joint_numbers(
        "limits of the torque rate, N m/s; torques are clipped, and other limits are not "
        "promised; none if empty",
        if_empty=np.inf,
        note="all > 0",
    )
    gains: Gains = group(Gains)
    safety_filter: bool = switch(
        "always keep a plan to rest within all limits; needed where acceleration limits are not"
        " available in every state",
        default=False,
    )
    torque_reserve: Array = joint_amounts(
        "torque that safety_filter keeps back for pushes, payloads and errors of the motors, N "
        "m; none if empty",
        note="less than 0.97 of torque_max",
    )
    qp_solver: str = text(
        "solver that is asked first; proxqp takes several times as long",
        default="daqp",
        choices=tuple(SOLVERS),
    )
    integral: IntegralConfiguration = group(IntegralConfiguration)
    friction: FrictionConfiguration = group(FrictionConfiguration)
    interaction: InteractionConfiguration = group(InteractionConfiguration)
    collision: CollisionConfiguration = group(CollisionConfiguration)
    start_control: str = text(
        "control of the joints until enable_torque is called",
        default="torque",
        choices=CONTROLS,
    )
    bounds_timeout: float = timeout(
        "how long a state waits for its acceleration limits before HOLD, s; no state for 1.5 "
        "times as long: STOPPED",
        default=0.05,
    )
    state_timeout: float = timeout(
        "time without a usable state after which the controller starts anew, s",
        default=0.5,
    )
    goal_ahead_max: float = timeout(
        "how far ahead of the joint states a goal's stamp may be, s; beyond it is refused",
        default=GOAL_AHEAD_MAX,
    )
    effort_tolerance: float = number(
        "allowed difference of reported and commanded torques, share of torque_max; beyond it "
        "commands count as ignored; 0: not compared",
        Range(0.0, 2.0),
        default=0.03,
    )
    ros2_control_topic: str = text(
        "topic for efforts as std_msgs/Float64MultiArray; none if empty", default=""
    )
    integral_settings: IntegralSettings = field(init=False)
    friction_settings: FrictionSettings = field(init=False)

    @property
    def settings(self) -> Settings:
        """What may change while the controller runs."""
        return Settings(
            self.gains,
            self.integral_settings,
            self.friction_settings,
            self.interaction.settings,
        )

    @property
    def clips_torque_rates(self) -> bool:
        """Whether torques are clipped to rates, so that no other limit is promised."""
        return bool(np.isfinite(self.torque_rate_max).any())

    @property
    def summary(self) -> str:
        """What kind of control it is, in words."""
        gravity = "with" if self.command_includes_gravity else "without"
        avoiding = "with" if self.collision.collision_avoidance else "without"
        clipped = "; torque_rate_max is clipped: limits are not promised with it"
        return (
            f"{self.start_control} control, torques {gravity} gravity, integral action "
            f"{self.integral.integral_action}, {avoiding} collision avoidance"
            f"{clipped if self.clips_torque_rates else ''}"
        )

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
        self._check_collision()

    def _check_collision(self) -> None:
        collision, low, high = self.collision, self.position_min, self.position_max
        q = collision.collision_posture
        if len(q) and not ((low <= q) & (q <= high) & np.isfinite(q)).all():
            raise SettingError("collision_posture", q, "within the position limits")
        if collision.collision_avoidance or self.safety_filter:
            for name in ("acceleration_min", "acceleration_max"):
                check_per_joint(name, getattr(collision, name), self.joints)
