# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests here."""

import sys
from pathlib import Path

from viability_bounds_pkg.testing.fixtures import graph_of_its_own, ros, shared_ros

sys.path.insert(0, str(Path(__file__).resolve().parent / "support"))

__all__ = ["graph_of_its_own", "ros", "shared_ros"]
