# SPDX-License-Identifier: Apache-2.0
"""Collision avoidance: constraints that keep links apart and away from obstacles."""

from torque_safety_controller.collision.avoidance import CollisionAvoidance, CollisionSettings
from torque_safety_controller.collision.bodies import (
    CollisionBody,
    box,
    capsule,
    half_space,
    make_obstacle,
    sphere,
)
from torque_safety_controller.collision.model import CollisionModel, build_collision_model

__all__ = [
    "CollisionAvoidance",
    "CollisionBody",
    "CollisionModel",
    "CollisionSettings",
    "box",
    "build_collision_model",
    "capsule",
    "half_space",
    "make_obstacle",
    "sphere",
]
