# SPDX-License-Identifier: Apache-2.0
"""Parameters of a new robot, found from its URDF: joints, limits, postures, capsules."""
