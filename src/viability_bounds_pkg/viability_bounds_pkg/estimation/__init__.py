# SPDX-License-Identifier: Apache-2.0
"""Worst-case acceleration limits from torque limits, and the zero-order hold error."""
