# SPDX-License-Identifier: Apache-2.0
"""Tasks: what the accelerations should do, and the goals that they serve."""
