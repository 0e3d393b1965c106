# SPDX-License-Identifier: Apache-2.0
"""Torque control inside joint, acceleration and torque limits, solved as a QP."""
