# SPDX-License-Identifier: Apache-2.0
"""Motions of the sample arm, of which some states are spoilt before they are looked at."""

import numpy as np
from sample_arm import MODEL, NONE, TAU_MAX, N

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import UNDECIDED, StateCheck

LIMIT = np.full(N, 2.5)
H = 0.002


def make_check(velocity_error=NONE, limit=LIMIT):
    return StateCheck(MODEL, -limit, limit, TAU_MAX, NONE, velocity_error)


def sine(t, size=0.75, w=2.0):
    """Return a motion in which all joints differ."""
    k = np.arange(1, N + 1)
    return State(size * np.sin(w * t + k), size * w * np.cos(w * t + k))


def play(check, spoil, begin=1.0, end=1.6, last=3.0, h=H, motion=sine):
    """Return the times at which states were refused, with what was wrong.

    The arm stops within 0.25 s where states are refused, and goes on when they are believed.
    """
    refused, along, pace = [], 0.0, 1.0
    for k in range(round(last / h)):
        t = k * h
        state = motion(along)
        state = state._replace(v=pace * state.v)
        if begin <= t < end:
            state = spoil(state, t)
        wrong = check.look(state, 5.0 + t)
        if wrong:
            refused.append((t, wrong))
        faster = min(max(pace + (-4.0 if wrong else 4.0) * h, 0.0), 1.0)
        along += 0.5 * (pace + faster) * h
        pace = faster
    return refused


def swapped(state, t):
    order = np.r_[1, 0, 2:N]
    return State(state.q[order], state.v[order])


def looks(check, states, stamps=None):
    """Return what states are said to be, H apart or at these times."""
    times = 5.0 + H * np.arange(len(states)) if stamps is None else stamps
    return [check.look(*each) for each in zip(states, times, strict=True)]


def leap(size):
    """Return what adds to the position of one joint, rad."""
    return lambda state, t: state._replace(q=state.q + size * np.eye(N)[2])


def refused_at(refused):
    """Return when states were refused, undecided ones left out, s."""
    return np.array([t for t, wrong in refused if wrong != UNDECIDED])
