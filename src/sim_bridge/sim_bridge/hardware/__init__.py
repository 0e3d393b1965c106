# SPDX-License-Identifier: Apache-2.0
"""Imperfect hardware: encoders, drives, motors and communication of a real robot."""

from sim_bridge.hardware.communication import CommandPath, MissedDeadlines
from sim_bridge.hardware.imperfections import Imperfections
from sim_bridge.hardware.motors import Motors
from sim_bridge.hardware.noise import ClippedNoise
from sim_bridge.hardware.sensing import Encoders, JointReading, Sensing

__all__ = [
    "ClippedNoise",
    "CommandPath",
    "Encoders",
    "Imperfections",
    "JointReading",
    "MissedDeadlines",
    "Motors",
    "Sensing",
]
