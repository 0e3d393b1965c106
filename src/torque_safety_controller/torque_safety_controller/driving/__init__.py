# SPDX-License-Identifier: Apache-2.0
"""Goals that move: jogs of the hand and of the joints, trajectories; no ROS."""
