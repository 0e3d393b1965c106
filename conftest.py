"""Fixtures for the tests of all packages."""

pytest_plugins = ["ros_harness", "arms"]
