# SPDX-License-Identifier: Apache-2.0
"""Fixtures and settings of the tests of all packages; each `conftest.py` imports the fixtures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

# Matrices here are small: a thread for each core only keeps other tests from running.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from viability_bounds_pkg.ros import diagnostics
from viability_bounds_pkg.testing.ros_harness import RosHarness, private_domain

# Every run tries the same examples; with --hypothesis-profile=explore it tries others.
settings.register_profile("same", deadline=None, derandomize=True, print_blob=True)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("same")


@pytest.fixture(scope="session", autouse=True)
def graph_of_its_own() -> Iterator[None]:
    """Keep what tests start with the default context, or as processes, to themselves.

    Nodes of this process report more often, so that tests wait less.
    """
    with private_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setattr(diagnostics, "DIAGNOSTICS_PERIOD", 0.05)
        yield


@contextmanager
def _harness() -> Iterator[RosHarness]:
    with private_domain() as domain:
        harness = RosHarness(domain)
        try:
            yield harness
        finally:
            harness.close()


@pytest.fixture
def ros() -> Iterator[RosHarness]:
    """A harness without nodes other than the probe."""
    with _harness() as harness:
        yield harness


@pytest.fixture(scope="module")
def shared_ros() -> Iterator[RosHarness]:
    """A harness for tests that leave no node in it, such as those of refusals at start."""
    with _harness() as harness:
        yield harness
