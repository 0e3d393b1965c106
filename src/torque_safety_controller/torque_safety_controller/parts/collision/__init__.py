# SPDX-License-Identifier: Apache-2.0
"""Collision avoidance: constraints that keep links apart and away from obstacles."""
