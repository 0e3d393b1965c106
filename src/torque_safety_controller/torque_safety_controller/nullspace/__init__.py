"""Null-space compliance: stiff in a task, free in its null space."""
