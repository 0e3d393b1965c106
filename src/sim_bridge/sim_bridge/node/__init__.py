# SPDX-License-Identifier: Apache-2.0
"""The nodes of robot, scenario and viewer, with their parameters and messages."""
