# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests here."""

from arms import arm

from viability_bounds_pkg.testing.fixtures import graph_of_its_own, ros, shared_ros

__all__ = ["arm", "graph_of_its_own", "ros", "shared_ros"]
