"""Tasks: what the accelerations should do, and the goals that they serve."""
