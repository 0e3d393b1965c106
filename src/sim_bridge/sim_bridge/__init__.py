# SPDX-License-Identifier: Apache-2.0
"""A torque-controlled robot played by PyBullet over ROS 2 topics."""

__version__ = "0.2.0"
