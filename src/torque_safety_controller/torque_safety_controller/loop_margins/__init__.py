# SPDX-License-Identifier: Apache-2.0
"""Which gains a robot bears: its loops with delay, motor lag and estimated states; no ROS."""
