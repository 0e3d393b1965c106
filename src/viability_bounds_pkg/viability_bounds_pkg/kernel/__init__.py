"""The viability kernel: one joint's bounds, in continuous and in discrete time."""
