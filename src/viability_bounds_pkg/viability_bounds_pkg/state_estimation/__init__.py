# SPDX-License-Identifier: Apache-2.0
"""The state in which a command will act: velocities estimated, delay and motor lag predicted."""
