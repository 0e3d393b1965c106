# SPDX-License-Identifier: Apache-2.0
"""The beginning of a program with a node of its own, for tests of how nodes start and end."""

SMALL_NODE = """
import os
import signal
import sys
from dataclasses import dataclass
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.program import run

@dataclass
class Nothing:
    pass

class SmallNode(ArmNode):
    PARAMETERS = Nothing
"""
