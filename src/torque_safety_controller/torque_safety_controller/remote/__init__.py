# SPDX-License-Identifier: Apache-2.0
"""For users of a controller that runs: a client for programs, the keyboard, MoveIt."""
