# SPDX-License-Identifier: Apache-2.0
"""A Franka arm, controlled over ROS 2 topics by libfranka's torque control."""

__version__ = "0.2.0"
