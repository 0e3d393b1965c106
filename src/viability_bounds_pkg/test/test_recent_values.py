# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np

from viability_bounds_pkg.recent_values import RecentValues


def test_percentiles_of_a_few_values_are_some_of_them():
    values = RecentValues()
    for value in (5.0, 1.0, 4.0, 2.0, 3.0):
        values.add(value)
    assert [values.percentile(p) for p in (0, 20, 50, 99, 100)] == [1.0, 1.0, 3.0, 5.0, 5.0]


def test_old_values_are_forgotten_but_the_largest():
    values = RecentValues()
    values.add(1e9)
    newest = np.random.default_rng(0).permutation(4096)
    for value in newest:
        values.add(float(value))
    assert values.percentile(100) == 4095.0
    assert values.percentile(50) == np.percentile(newest, 50, method="inverted_cdf")
    assert values.largest == 1e9


def test_without_values_nothing_is_known():
    values = RecentValues()
    assert math.isnan(values.percentile(50)) and math.isnan(values.largest)
