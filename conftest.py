"""Fixtures and settings for the tests of all packages."""

import os

# Matrices here are small: a thread for each core only keeps other tests from running.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

pytest_plugins = ["ros_harness", "arms"]
