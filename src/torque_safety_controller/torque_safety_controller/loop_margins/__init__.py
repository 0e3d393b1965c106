# SPDX-License-Identifier: Apache-2.0
"""Largest gains of a robot: its loops with delay, motor lag and estimated states; no ROS."""
