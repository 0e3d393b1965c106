"""Tools that move the simulated robot."""
