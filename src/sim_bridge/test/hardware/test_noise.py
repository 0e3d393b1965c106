# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from sim_bridge.hardware import NOISE_CLIP, ClippedNoise, RandomStream

DEVIATION = np.array([0.5, 0.0, 2.0])


def draws(count=1, seed=3, stream=RandomStream.POSITION):
    noise = ClippedNoise(DEVIATION, seed, stream)
    return np.array([noise.added_to(np.zeros(3)) for _ in range(count)])


def test_it_has_its_deviation_and_never_more_than_three_of_it():
    values = draws(20_000)
    inside = math.erf(NOISE_CLIP / math.sqrt(2.0))
    density = math.exp(-0.5 * NOISE_CLIP**2) / math.sqrt(2.0 * math.pi)
    clipped = math.sqrt(inside - 2.0 * NOISE_CLIP * density + NOISE_CLIP**2 * (1.0 - inside))
    np.testing.assert_allclose(values.std(axis=0), clipped * DEVIATION, rtol=0.02)
    assert (np.abs(values) <= 3.0 * DEVIATION).all()
    assert (np.abs(values).max(axis=0) == 3.0 * DEVIATION).all()
    assert np.abs(values.mean(axis=0)).max() < 0.05


def test_joints_and_times_are_independent():
    values = draws(20_000)
    assert abs(np.corrcoef(values[:, 0], values[:, 2])[0, 1]) < 0.03
    assert abs(np.corrcoef(values[1:, 0], values[:-1, 0])[0, 1]) < 0.03


def test_the_same_seed_gives_the_same_numbers_and_another_one_others():
    np.testing.assert_array_equal(draws(9), draws(9))
    assert (draws(9, seed=4)[:, 0] != draws(9)[:, 0]).all()
    assert (draws(9, stream=RandomStream.VELOCITY)[:, 0] != draws(9)[:, 0]).all()


def test_a_reset_begins_the_numbers_anew():
    noise = ClippedNoise(DEVIATION, 0, RandomStream.VELOCITY)
    first = [noise.added_to(np.ones(3)) for _ in range(5)]
    noise.reset()
    np.testing.assert_array_equal([noise.added_to(np.ones(3)) for _ in range(5)], first)


def test_without_a_deviation_the_value_itself_comes_back():
    value = np.ones(3)
    assert ClippedNoise(np.zeros(3), 0, RandomStream.POSITION).added_to(value) is value


@pytest.mark.parametrize("stream", RandomStream)
def test_each_kind_of_error_has_numbers_of_its_own(stream):
    others = [each for each in RandomStream if each != stream]
    for other in others:
        assert draws(stream=stream)[0, 0] != draws(stream=other)[0, 0]
