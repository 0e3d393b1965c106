# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np

from viability_bounds_pkg.recent_values import RecentValues


def test_percentiles_are_of_the_newest_values_and_the_largest_is_of_all():
    values, newest = RecentValues(), np.random.default_rng(0).permutation(4096).astype(float)
    for value in (1e9, *newest):
        values.add(value)
    for percent in (0, 50, 99, 100):
        expected = np.percentile(newest, percent, method="inverted_cdf")
        assert values.percentile(percent) == expected
    assert values.largest == 1e9


def test_without_values_nothing_is_known():
    values = RecentValues()
    assert math.isnan(values.percentile(50)) and math.isnan(values.largest)
