# SPDX-License-Identifier: Apache-2.0
"""The robot node and the scenario node, with their parameters and messages."""
