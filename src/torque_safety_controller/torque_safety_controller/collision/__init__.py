"""Collision avoidance: distances that can always be kept."""
