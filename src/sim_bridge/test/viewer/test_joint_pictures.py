# SPDX-License-Identifier: Apache-2.0
import math
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_bridge.viewer.joint_pictures import JointPictures, JointValues, colour, usage
from viability_bounds_pkg.joint_limits import JointLimits

LIMITS = JointLimits(
    ("shoulder", "elbow", "<wrist>"),
    np.array([-1.0, -2.0, -math.inf]),
    np.array([1.0, 0.5, math.inf]),
    np.array([2.0, 3.0, 4.0]),
    np.array([-5.0, -10.0, -20.0]),
    np.array([5.0, 10.0, 20.0]),
)
TAU_MAX = np.array([50.0, 20.0, 5.0])
SVG = "{http://www.w3.org/2000/svg}"


def values(q=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), tau=(0.0, 0.0, 0.0), limits=math.nan):
    three = np.full(3, limits)
    return JointValues(*map(np.array, (q, v, tau)), np.zeros(3), three, three)


def test_usage_is_one_on_the_border_of_the_kernel():
    # From q the speed sqrt(2 a (q_max - q)) can just be braked before q_max.
    q = np.array([0.9, 0.4, 7.0])
    v = np.array([math.sqrt(2 * 5.0 * 0.1), math.sqrt(2 * 10.0 * 0.1), 4.0])
    assert usage(values(q, v), LIMITS, TAU_MAX) == pytest.approx(1.0)
    assert usage(values(q, 0.5 * v), LIMITS, TAU_MAX) == pytest.approx(0.5)
    # Away from the limit only the speed limit counts.
    assert usage(values(q, -0.5 * v), LIMITS, TAU_MAX)[0] == pytest.approx(0.25)


def test_usage_counts_torque_and_what_is_at_or_beyond_a_position_limit():
    assert usage(values(tau=(25.0, -20.0, 0.0)), LIMITS, TAU_MAX) == pytest.approx([0.5, 1.0, 0])
    assert usage(values(q=(1.0, 0.6, 9.0)), LIMITS, TAU_MAX) == pytest.approx([1.0, 1.0, 0.0])
    unknown = values(tau=(math.nan,) * 3)
    assert usage(unknown, LIMITS, TAU_MAX) == pytest.approx(0.0)


def test_colours_go_from_green_to_red():
    greens = [colour(share)[1] for share in (0.0, 0.8, 1.0)]
    reds = [colour(share)[0] for share in (0.0, 0.8)]
    assert colour(0.0) == colour(0.4)
    assert colour(3.0) == colour(1.0)
    assert greens[2] < greens[1]
    assert reds[0] < reds[1]


@given(
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    st.lists(st.floats(-9.0, 9.0), min_size=3, max_size=3),
    st.sampled_from([math.nan, 0.0, 100.0]),
)
def test_every_state_gives_a_picture_without_nan(q, v, limits):
    picture = JointPictures(LIMITS.names, LIMITS, TAU_MAX).draw(values(q, v, limits=limits))
    assert "nan" not in picture and "inf" not in picture
    root = ElementTree.fromstring(picture)
    assert len(list(root.iter(f"{SVG}circle"))) == 3
    assert "<wrist>" in {text.text for text in root.iter(f"{SVG}text")}


def test_the_state_on_the_border_is_drawn_on_the_border():
    pictures = JointPictures(LIMITS.names, LIMITS, TAU_MAX)
    root = ElementTree.fromstring(pictures.draw(values(v=(2.0, 0.0, 0.0))))
    dot = next(root.iter(f"{SVG}circle"))
    kernel = list(root.iter(f"{SVG}polygon"))[1]
    ups = [float(point.split(",")[1]) for point in kernel.get("points").split()]
    assert float(dot.get("cy")) == pytest.approx(min(ups))
    width = [float(point.split(",")[0]) for point in kernel.get("points").split()]
    assert float(dot.get("cx")) == pytest.approx(0.5 * (min(width) + max(width)), abs=0.1)
