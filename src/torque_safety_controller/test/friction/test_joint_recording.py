# SPDX-License-Identifier: Apache-2.0
"""Recorded joint states: how they are read, and averages over blocks of them."""

import math

import numpy as np
import pytest

from torque_safety_controller.friction.joint_recording import (
    Recording,
    RecordingError,
    load_recording,
    make_blocks,
)

JOINTS = ("shoulder", "elbow")


def arrays(count=200):
    """A recording of two joints at 1 kHz."""
    t = 1e-3 * np.arange(count)
    return {
        "t": t,
        "q": np.column_stack([0.3 * t**2, 1.0 - 0.1 * t]),
        "v": np.column_stack([0.6 * t, np.full(count, -0.1)]),
        "tau": np.column_stack([t, 2.0 - t]),
    }


def loaded(tmp_path, contents):
    path = tmp_path / "run.npz"
    np.savez(path, **contents)
    return load_recording(path, JOINTS)


def test_it_is_read_as_it_was_written_and_columns_are_found_by_name(tmp_path):
    given, names = arrays(), np.array(["elbow", "other", "shoulder"])
    wider = {
        key: np.column_stack([given[key][:, 1], np.full(200, 7.0), given[key][:, 0]])
        for key in ("q", "v", "tau")
    }
    for contents in (given, {"joints": names, "t": given["t"], **wider}):
        recording = loaded(tmp_path, contents)
        for key, value in given.items():
            np.testing.assert_array_equal(getattr(recording, key), value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"tau": None}, "array missing: .*tau"),
        ({"t": np.zeros((200, 1))}, r"'t' must have shape \(N,\)"),
        ({"t": np.zeros(200)}, "'t' does not increase after sample 0"),
        ({"q": np.zeros((200, 3))}, "'q' must have one column for each of 2 joints"),
        ({"v": np.zeros((199, 2))}, r"'v' must have shape \(200, 2\), has \(199, 2\)"),
        ({"tau": np.full((200, 2), math.nan)}, "'tau' has numbers that are not finite"),
        ({"tau": np.full((200, 2), "x")}, "no NumPy file of arrays of numbers"),
        ({"joints": np.array(["shoulder", "wrist"])}, "joint 'elbow' is missing"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, changed, message):
    contents = {key: value for key, value in (arrays() | changed).items() if value is not None}
    with pytest.raises(RecordingError, match=message):
        loaded(tmp_path, contents)


def test_blocks_are_averages():
    blocks = make_blocks(Recording(**arrays(201)), 0.02)
    np.testing.assert_allclose(blocks.t, 0.01 + 0.02 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose(blocks.a, [[0.6, 0.0]] * 10, atol=1e-9)
    np.testing.assert_allclose(blocks.v[:, 0], 0.6 * blocks.t, atol=1e-12)
    # Of torque, samples 1 to 20: it acted until then.
    np.testing.assert_allclose(blocks.tau[:, 0], blocks.t + 0.5e-3, atol=1e-12)
    np.testing.assert_allclose(blocks.bend, 0.0, atol=1e-12)
    with pytest.raises(RecordingError, match="too short: 0.01 s"):
        make_blocks(Recording(**arrays(11)), 0.02)


def test_gaps_are_left_out():
    contents = arrays(1001)
    contents["t"][503:] += 0.7
    blocks = make_blocks(Recording(**contents), 0.02)
    assert len(blocks.t) == 49
    np.testing.assert_allclose(blocks.a[:, 0], 0.6, atol=1e-9)
