# SPDX-License-Identifier: Apache-2.0
"""Imperfect hardware: encoders, drives, motors and communication of a real robot."""
