"""Worst-case acceleration limits from torque limits, and the cost of holding a torque."""
