"""The robot node and the scenario node, with their parameters and messages."""
