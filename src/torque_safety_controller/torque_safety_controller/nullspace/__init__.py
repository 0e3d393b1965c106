# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance: stiff in a task, free in its null space."""
