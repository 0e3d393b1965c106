# SPDX-License-Identifier: Apache-2.0
"""Arms driven into obstacles and into themselves, and where they end."""

import numpy as np
import pytest
from collision_arm import Journey, box, half_space, panda, sphere, two_links

from torque_safety_controller.parts.collision.avoidance import Collision
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.joint_limits import JointLimits

MARGIN, RESERVE = 0.02, 0.002  # m
TOLERANCE = 5e-4  # m; of the reserve, what may be used in these motions
DT = 2e-3
BALL = '<sphere radius="0.05"/>'


def journey(obstacles=True, move=None):
    arm, limits, collision = panda(obstacles)
    avoidance = Collision(collision, limits.a_min, limits.a_max, 2.0 * DT)
    return arm, Journey(avoidance, arm.robot(DT), limits, move)


def planar_journey(shape, reach, obstacle, *kind, kp=30.0, **constants):
    avoidance, model = two_links(shape, reach, [obstacle], *kind, dt=2.0 * DT, **constants)
    ends, most = np.full(2, 3.0), np.full(2, 20.0)
    limits = JointLimits(tuple(model.names)[1:], -ends, ends, ends, -most, most)
    return Journey(avoidance, RobotModel(model, "fore", DT), limits, kp=kp)


def test_random_goals_among_obstacles_keep_the_margin():
    arm, trip = journey()
    rng = np.random.default_rng(1)
    q = arm.q_start
    for _ in range(3):
        q, _ = trip.go(q, rng.uniform(arm.q_min, arm.q_max), 2.0)
    assert min(trip.distances) > MARGIN + RESERVE - TOLERANCE
    near = np.count_nonzero(np.array(trip.distances) < MARGIN + 1.5 * RESERVE)
    assert near > 300, "nothing was in the way"


@pytest.mark.parametrize("obstacles", [True, False])
def test_the_hand_driven_into_the_arm_or_the_table_stops_before_it(obstacles):
    """Under torques held for a step, by forward dynamics, as a robot moves."""
    arm, trip = journey(obstacles, lambda q, v, step: arm.move(q, v, step.tau, DT, 2))
    goal = arm.q_start.copy()
    if obstacles:
        goal[1:4] = [1.5, 0.0, -0.6]  # stretched out, down through the table
    else:
        goal[1:6] = [-0.5, 0.0, -3.0, 0.0, 0.3]  # folded, the hand into the base
    q, v = trip.go(arm.q_start, goal, 4.0)
    assert min(trip.distances) > MARGIN + RESERVE - TOLERANCE
    assert trip.distances[-1] < 0.05, "it did not come near"
    assert np.abs(goal - q).max() > 0.1, "the goal was free"
    assert np.abs(v).max() < 2e-3  # rad/s


def test_a_planar_arm_against_a_narrow_block_keeps_it_with_its_whole_length():
    """The rod is longer than the block: the closest point jumps between ends and edges."""
    rod = '<cylinder radius="0.03" length="0.5"/>'
    block = box("block", [0.75, 0.2, 0.0], [0.1, 0.1, 0.2])
    trip = planar_journey(rod, 0.25, block, kp=100.0, margin=0.01)
    q = np.zeros(2)
    for goal in ([0.6, -0.8], [-0.3, 1.2], [0.5, 0.5], [0.2, -0.1], [0.6, -1.4]):
        q, _ = trip.go(q, np.array(goal), 1.2)
    assert min(trip.distances) > 0.01 + RESERVE - TOLERANCE
    assert sum(d < 0.015 for d in trip.distances) > 200


@pytest.mark.parametrize(
    ("way", "depth"),
    [
        (
            ('<cylinder radius="0.05" length="0.4"/>', 0.2, sphere("it", [0.7, 0.05, 0], 0.05)),
            0.05,
        ),
        ((BALL, 0.4, half_space("it", [0.85, 0, 0], [-1.0, 0, 0]), "prismatic", "1 0 0"), 0.1),
    ],
    ids=["rod and ball", "ball and wall"],
)
def test_an_arm_that_overlaps_at_the_start_gets_out_slowly_and_stays_out(way, depth):
    """The bounds hold meanwhile, and it is said that the state is not viable."""
    trip = planar_journey(*way)
    trip.go(np.zeros(2), np.array([0.3, 0.2]), 3.0)
    assert trip.distances[0] == pytest.approx(-depth, abs=2e-3)  # a prism around a rod
    assert not trip.viable[0]
    out = next(k for k, d in enumerate(trip.distances) if d > MARGIN)
    assert out < 1300
    assert min(trip.distances[out:]) > MARGIN
    # At 0.1 m/s, after the time to get there.
    assert np.diff(trip.distances[:out]).max() < 0.1 * DT * 1.1
