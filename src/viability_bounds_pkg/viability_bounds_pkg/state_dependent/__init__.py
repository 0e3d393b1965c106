"""Acceleration limits from the torque available in the present state."""
