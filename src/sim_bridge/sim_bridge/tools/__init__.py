"""Command line tools and a camera for the simulated robot."""
