# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes that are killed, stand still or start late, beside a robot in this one."""

import numpy as np
import process_faults
import pytest
from moments import Seen
from process_faults import FAULTS, Bench, Kind

from viability_bounds_pkg.testing.ros_harness import RosHarness, private_domain

pytestmark = pytest.mark.long

RATE = 100.0  # Hz, which a busy machine can do
STEP = 1e-5  # rad; a h^2 / 8 in a physics step, for which only the bounds have a margin
ALL = {"use_sim_time": True, "robot_description": "topic"}


def bench_of(ros, kind):
    return Bench(ros, "panda", kind, np.random.default_rng(3), RATE)


def kept(seen):
    return seen.position < STEP and seen.speed == 0.0 and 0.0 < seen.torque <= 1.0 + 1e-9


@pytest.fixture(scope="module")
def bench():
    """A robot here, bounds and controller as processes, all by a clock that may jump."""
    with private_domain() as domain:
        ros = RosHarness(domain)
        made = bench_of(ros, Kind(process_faults.nothing, values=ALL))
        try:
            made.start_all()
            yield made
        finally:
            made.close()
            ros.close()


@pytest.mark.parametrize(
    ("fault", "brakes"),
    [
        ("bounds killed", True),
        ("controller killed", True),
        ("both stopped and continued", False),
        ("wild parameters", False),
        ("the clock jumps", False),
        ("no room for logs", False),
        ("another robot description", False),
    ],
)
def test_limits_are_kept_and_the_arm_goes_on(bench, fault, brakes):
    seen = Seen(timeout=bench.timeout, brakes=brakes)
    bench.motion(0.5)
    bench.arm._monitor.reset()
    bench.suffer(seen, FAULTS[fault].course(bench))
    bench.motion(0.5)  # or it fails
    bench.note_limits(seen)
    assert kept(seen), seen
    assert np.isfinite(seen.braking[0]) or not brakes, "the fault had no effect"
    assert all(each.running for each in bench.programs.values())


@pytest.mark.parametrize("late", ["robot late", "controller late"])
def test_a_node_that_starts_late_is_found(late):
    with private_domain() as domain:
        ros = RosHarness(domain)
        made = bench_of(ros, FAULTS[late])
        try:
            made.start_all()
            seen = Seen(timeout=made.timeout)
            made.suffer(seen, FAULTS[late].course(made))
            made.motion(0.5)
            made.note_limits(seen)
            assert kept(seen), seen
        finally:
            made.close()
            ros.close()
