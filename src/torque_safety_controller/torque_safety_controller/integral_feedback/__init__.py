"""Integral torque feedback that cannot wind up."""
