# SPDX-License-Identifier: Apache-2.0
"""The robot's node, with its parameters and messages."""
