"""Torque control inside joint, acceleration and torque limits, solved as a QP."""
