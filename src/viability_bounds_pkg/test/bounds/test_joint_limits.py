# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError

GOOD = {
    "names": ["shoulder", "elbow"],
    "q_min": [-1.0, -2.0],
    "q_max": [1.0, 2.0],
    "v_max": [2.0, 3.0],
    "a_min": [-10.0, -11.0],
    "a_max": [9.0, 8.0],
}


def test_keeps_values_as_read_only_arrays():
    given = np.array([9.0, 8.0])
    limits = JointLimits(**{**GOOD, "a_max": given})
    given[0] = -1.0
    assert limits.names == ("shoulder", "elbow")
    assert limits.a_max.tolist() == [9.0, 8.0]
    assert len(limits) == 2
    for field in ("q_min", "q_max", "v_max", "a_min", "a_max"):
        array = getattr(limits, field)
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    with pytest.raises(AttributeError):
        limits.v_max = None


def test_allows_joints_without_position_limits():
    limits = JointLimits(**{**GOOD, "q_min": [-math.inf, -math.inf], "q_max": [math.inf, 2.0]})
    assert limits.q_min[0] == -math.inf


@pytest.mark.parametrize(
    ("field", "value", "joint"),
    [
        ("names", [], None),
        ("names", "ab", None),
        ("names", ["elbow", "elbow"], "elbow"),
        ("names", ["elbow", ""], None),
        ("names", ["elbow", 3], None),
        ("q_min", [-1.0], None),
        ("q_min", -1.0, None),
        ("q_min", [[-1.0, -2.0]], None),
        ("q_min", ["low", "lower"], None),
        ("q_min", [-1.0, math.nan], "elbow"),
        ("q_min", [math.inf, -2.0], "shoulder"),
        ("q_max", [1.0, -math.inf], "elbow"),
        ("q_max", [1.0, -2.0], "elbow"),
        ("q_max", [-3.0, 2.0], "shoulder"),
        ("v_max", [2.0, 0.0], "elbow"),
        ("v_max", [2.0, -1.0], "elbow"),
        ("v_max", [math.inf, 1.0], "shoulder"),
        ("v_max", [math.nan, 1.0], "shoulder"),
        ("a_min", [0.0, -1.0], "shoulder"),
        ("a_min", [1.0, -1.0], "shoulder"),
        ("a_min", [-math.inf, -1.0], "shoulder"),
        ("a_max", [9.0, -1.0], "elbow"),
        ("a_max", [9.0, 0.0], "elbow"),
        ("a_max", [9.0, math.inf], "elbow"),
        ("a_max", [9.0, 8.0, 7.0], None),
    ],
)
def test_refuses(field, value, joint):
    with pytest.raises(JointLimitsError) as caught:
        JointLimits(**{**GOOD, field: value})
    error = caught.value
    assert isinstance(error, ValueError)
    assert (error.field, error.joint) == (field, joint)
    assert error.allowed in str(error)
    assert field in str(error)
    if joint is not None:
        assert joint in str(error)
