# SPDX-License-Identifier: Apache-2.0
"""Parameters declared as fields of a dataclass: checked at start and when they change."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from rclpy.parameter import Parameter

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    POSITIVE,
    Range,
    above,
    group,
    joint_numbers,
    number,
    numbers,
    read,
    switch,
    text,
    texts,
    whole_number,
)
from viability_bounds_pkg.parameter_files import remember_arguments
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.parameters import NodeParameters, UnknownParameterError
from viability_bounds_pkg.testing.ros_harness import overrides


@dataclass(frozen=True)
class Size:
    count: int = whole_number("of something", Range(1, 5), default=3, live=True)
    pair: np.ndarray = numbers("two of them", length=2, default=(1.0, 2.0), live=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class Configuration:
    joints: tuple[str, ...] = texts("names")
    limits: np.ndarray = joint_numbers("one a joint, m", POSITIVE)
    extra: np.ndarray = joint_numbers("may be left out", default=())
    filled: np.ndarray = joint_numbers("may be left out, too", if_empty=7.0)
    rate: float = number("Hz", above(0.0, 1e3))
    gain: float = number("1/s", above(0.0, 1e3), default=2.0, live=True)
    offset: float = number("less than the gain, 1/s", default=1.0, live=True)
    damping: float = number("-1: critical", Range(0.0, 9.0, special=-1.0), default=-1.0, live=True)
    size: Size = group(Size)
    far: Size = group(Size, "far_")
    shape: str = text("of it", default="round", live=True, choices=("round", "flat"))
    enabled: bool = switch("or not", default=True, live=True)

    def __post_init__(self):
        if self.gain <= self.offset:
            raise SettingError("offset", self.offset, "less than gain")

    @property
    def changing(self):
        return self.gain, self.offset, self.shape


VALUES = {"joints": ["a", "b"], "limits": [1.0, 2.0], "rate": 100.0}


class Tunable(ArmNode):
    NAME = "tunable"
    PARAMETERS = Configuration

    def __init__(self, **node_arguments):
        super().__init__(**node_arguments)
        self.changes = []
        self.parameters = NodeParameters(
            self, Configuration, lambda config: self.changes.append(config.changing), self.check
        )

    @property
    def config(self):
        return self.parameters.configuration

    def check(self, config):
        if config.damping > config.rate:
            raise SettingError("damping", config.damping, "at most rate")


def start(ros, **changed) -> Tunable:
    return ros.start(Tunable, VALUES | changed)


def test_values_and_defaults_arrive_and_whole_numbers_count_as_floats(ros):
    config = start(ros, gain=4, limits=[1, 2], far_count=4).config
    assert config.changing == (4.0, 1.0, "round")
    assert config.joints == ("a", "b")
    np.testing.assert_array_equal(config.limits, [1.0, 2.0])
    assert config.limits.dtype == float
    assert config.extra.shape == (0,)
    np.testing.assert_array_equal(config.filled, [7.0, 7.0])
    assert (config.size.count, config.far.count, config.enabled) == (3, 4, True)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"rate": None}, "parameter 'rate' is not set; allowed: a number"),
        ({"limits": None}, "parameter 'limits' is not set; allowed: a list of numbers"),
        ({"rate": "fast"}, "parameter 'rate' is 'fast'; allowed: a number"),
        ({"joints": "a"}, "parameter 'joints' is 'a'; allowed: a list of strings"),
        ({"joints": [1, 2]}, "parameter 'joints' is [1, 2]; allowed: a list of strings"),
        ({"joints": []}, "parameter 'joints' is []; allowed: at least one joint "),
        ({"joints": ["a", "a"]}, "parameter 'joints' is ['a', 'a']; allowed: at least one joint "),
        ({"limits": 1.0}, "parameter 'limits' is 1; allowed: a list of numbers"),
        ({"limits": [True, False]}, "parameter 'limits' is [true, false]; allowed: a list of "),
        ({"limits": [1.0]}, "parameter 'limits' is [1]; allowed: 2 numbers, one for each of "),
        ({"limits": [1.0, 0.0]}, "parameter 'limits' is [1, 0]; allowed: finite numbers > 0, one"),
        ({"limits": [1.0, math.inf]}, "parameter 'limits' is [1, inf]; allowed: finite numbers"),
        (
            {"limits": [1.0, 1e13]},
            "parameter 'limits' is [1, 1e+13]; allowed: numbers up to 1e+12",
        ),
        ({"extra": [1.0, math.nan]}, "parameter 'extra' is [1, nan]; allowed: numbers, not NaN"),
        ({"rate": 0.0}, "parameter 'rate' is 0; allowed: a number > 0 and <= 1000"),
        ({"rate": 10**400}, f"parameter 'rate' is {10**400}; allowed: a number"),
        ({"rate": math.nan}, "parameter 'rate' is nan; allowed: a number > 0 and <= 1000"),
        ({"gain": 0.5}, "parameter 'offset' is 1; allowed: less than gain"),
    ],
)
def test_bad_values_are_refused_in_one_line(changed, expected):
    with pytest.raises(SettingError) as refusal:
        read(Configuration, VALUES | changed)
    assert str(refusal.value).startswith(expected)
    assert "\n" not in str(refusal.value)
    assert refusal.value.name in expected


def test_what_the_command_line_gives_is_checked(ros):
    for rule, error, line in (
        ("offsset:=1.0", UnknownParameterError, "'offsset'; did you mean 'offset'"),
        ("gain:=[[1.0]]", SettingError, "'gain' is .*; allowed: a number"),
        ("rate:=2001-01-01", SettingError, "'rate' is 2001-01-01; allowed: a number"),
        ("joints:=[]", SettingError, "'joints' is not set; allowed: a list of strings$"),
    ):
        remember_arguments(ros.context, ["--ros-args", "-p", rule])
        with pytest.raises(error, match=line):
            start(ros)
    remember_arguments(ros.context, ["--ros-args", "-p", "pose_kp:=1.0"])  # of another node
    assert not start(ros).has_parameter("pose_kp")


def test_a_change_arrives_once_and_all_of_it(ros):
    node = start(ros)
    ros.accepts("tunable", gain=5)  # ros2 param set sends a whole number for "5"
    assert node.changes == [(5.0, 1.0, "round")]
    ros.accepts("tunable", shape="flat")
    assert node.changes[1:] == [(5.0, 1.0, "flat")]
    ros.accepts("tunable", far_pair=[3.0, 4.0])
    np.testing.assert_array_equal(node.config.far.pair, [3.0, 4.0])
    np.testing.assert_array_equal(node.config.size.pair, [1.0, 2.0])


def test_bad_changes_are_refused_and_the_old_values_stay(ros):
    node = start(ros, rate=8.0)
    config = node.config
    for name, value, expected in (
        # What is outside of the range that the description shows, rclpy refuses itself.
        ("gain", math.nan, "Parameter gain out of range Min: 0.0, Max: 1000.0, value: nan"),
        ("count", 6, "Parameter count out of range. Min: 1, Max: 5, value: 6"),
        ("gain", 0.0, "parameter 'gain' is 0; allowed: a number > 0 and <= 1000"),
        ("damping", -0.5, "parameter 'damping' is -0.5; allowed: a number >= 0 and <= 9, or -1"),
        ("far_pair", [1.0], "parameter 'far_pair' is [1]; allowed: 2 numbers"),
        ("gain", True, "parameter 'gain' is true; allowed: a number"),
        ("count", 1.5, "parameter 'count' is 1.5; allowed: a whole number"),
        ("enabled", 1, "parameter 'enabled' is 1; allowed: true or false"),
        ("shape", "oval", "parameter 'shape' is 'oval'; allowed: one of round, flat"),
        # Fine by itself, but not together with the others, or not for the node.
        ("offset", 2.0, "parameter 'offset' is 2; allowed: less than gain"),
        ("damping", 8.5, "parameter 'damping' is 8.5; allowed: at most rate"),
        # Not live.
        ("rate", 200.0, "Trying to set a read-only parameter: rate."),
    ):
        before = node.get_parameter(name).value
        assert ros.refuses("tunable", **{name: value}) == expected
        np.testing.assert_array_equal(node.get_parameter(name).value, before)
    (deleted,) = node.set_parameters([Parameter("gain", Parameter.Type.NOT_SET)])
    assert deleted.reason == "parameters cannot be deleted"
    assert node.config is config
    assert node.changes == []


def test_changes_that_fit_only_together_are_made_at_once(ros):
    node = start(ros)
    assert not ros.set_parameters("tunable", offset=3.0, gain=5.0)[0].successful
    assert node.config.changing == (5.0, 1.0, "round")
    result = node.set_parameters_atomically(overrides({"offset": 6.0, "gain": 8.0}))
    assert result.successful
    assert node.changes == [(5.0, 1.0, "round"), (8.0, 6.0, "round")]
    result = node.set_parameters_atomically(overrides({"shape": "flat", "gain": -1.0}))
    assert not result.successful
    assert node.config.changing == (8.0, 6.0, "round")
