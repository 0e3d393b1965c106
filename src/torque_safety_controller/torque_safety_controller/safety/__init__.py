"""The last checks of a torque, the disturbance observer, modes and handover."""
