"""Scenarios: what happens when, and the report of a run."""
