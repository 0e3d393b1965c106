"""The bounds node and its parameters."""
