# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError

GOOD = {
    "names": ["shoulder", "elbow"],
    "q_min": [-1.0, -math.inf],
    "q_max": [1.0, 2.0],
    "v_max": [2.0, 3.0],
    "a_min": [-10.0, -11.0],
    "a_max": [9.0, 8.0],
    "velocity_offset": [0.5, 0.0],
    "deceleration_limit": [4.0, math.inf],
}


def test_values_are_kept_and_cannot_be_changed():
    given = np.array([9.0, 8.0])
    limits = JointLimits(**{**GOOD, "a_max": given})
    given[0] = -1.0
    assert limits.names == ("shoulder", "elbow")
    assert limits.a_max.tolist() == [9.0, 8.0]
    with pytest.raises(ValueError, match="read-only"):
        limits.a_max[0] = 0.0
    with pytest.raises(AttributeError):
        limits.v_max = None


@pytest.mark.parametrize(
    ("field", "value", "joint"),
    [
        ("names", [], None),
        ("names", "ab", None),
        ("names", ["elbow", "elbow"], "elbow"),
        ("names", ["elbow", ""], None),
        ("q_min", [-1.0], None),
        ("q_min", [[-1.0, -2.0]], None),
        ("q_min", ["low", "lower"], None),
        ("q_min", [-1.0, math.nan], "elbow"),
        ("q_min", [math.inf, -2.0], "shoulder"),
        ("q_max", [1.0, -math.inf], "elbow"),
        ("q_max", [-3.0, 2.0], "shoulder"),
        ("v_max", [2.0, 0.0], "elbow"),
        ("v_max", [math.inf, 1.0], "shoulder"),
        ("a_min", [0.0, -1.0], "shoulder"),
        ("a_max", [9.0, math.inf], "elbow"),
        ("deceleration_limit", [4.0, 0.0], "elbow"),
        ("velocity_offset", [-0.1, 0.5], "shoulder"),
        ("velocity_offset", [math.inf, 0.5], "shoulder"),
        ("velocity_offset", [0.5, 0.5], "elbow"),  # it has no deceleration_limit
        ("velocity_offset", [3.0, 0.0], "shoulder"),  # 9 / 4 rad of the 2 rad
    ],
)
def test_limits_that_cannot_be_are_refused(field, value, joint):
    with pytest.raises(JointLimitsError) as refused:
        JointLimits(**{**GOOD, field: value})
    assert (refused.value.field, refused.value.joint) == (field, joint)
    assert refused.value.allowed in str(refused.value)
    assert str(refused.value).startswith(field if joint is None else f"{field} of joint '{joint}'")


def test_speed_limits_depend_on_the_distance_to_position_limits():
    limits = JointLimits(**GOOD)
    rest = 0.5**2 / 8.0
    assert limits.rest_distance.tolist() == [rest, 0.0]
    q = np.array([[0.0, 1.9], [1.0 - rest, 2.0], [0.99, 9.0], [-0.9, -9.0], [5.0, 0.0]])
    slowest = math.sqrt(2.0 * 4.0 * 0.1) - 0.5  # 0.1 rad before the limit
    lower, upper = limits.velocities(q)
    np.testing.assert_allclose(lower, [[-2, -3], [-2, -3], [-2, -3], [-slowest, -3], [-2, -3]])
    np.testing.assert_allclose(upper, [[2, 3], [0, 3], [0, 3], [2, 3], [0, 3]], atol=1e-15)
