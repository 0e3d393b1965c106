# SPDX-License-Identifier: Apache-2.0
import math
from array import array
from dataclasses import dataclass
from typing import Any

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
from viability_bounds_pkg.robot.configuration import RobotConfiguration
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.given_parameters import remember_arguments
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

    def check(self, config):
        if config.damping > config.rate:
            raise SettingError("damping", config.damping, "at most rate")


def start(ros, **changed) -> Tunable:
    return ros.start(Tunable, VALUES | changed)


def test_values_and_defaults_arrive(ros):
    node = start(ros, gain=4.5)
    config = node.parameters.configuration
    assert config.changing == (4.5, 1.0, "round")
    assert config.joints == ("a", "b")
    np.testing.assert_array_equal(config.limits, [1.0, 2.0])
    assert config.extra.shape == (0,)
    np.testing.assert_array_equal(config.filled, [7.0, 7.0])
    assert (config.size.count, config.enabled) == (3, True)


def test_parameters_of_a_group_may_have_a_prefix(ros):
    node = start(ros, far_count=4)
    config = node.parameters.configuration
    assert (config.size.count, config.far.count) == (3, 4)
    ros.accepts("tunable", far_pair=[3.0, 4.0])
    np.testing.assert_array_equal(node.parameters.configuration.far.pair, [3.0, 4.0])
    np.testing.assert_array_equal(node.parameters.configuration.size.pair, [1.0, 2.0])
    assert ros.refuses("tunable", far_pair=[1.0]) == (
        "parameter 'far_pair' is [1]; allowed: 2 numbers"
    )


def test_a_dataclass_of_parameters_has_their_defaults():
    assert Size().count == 3
    np.testing.assert_array_equal(Size().pair, [1.0, 2.0])


def test_whole_numbers_are_taken_for_floats(ros):
    node = start(ros, gain=4, rate=100, limits=[1, 2])
    assert node.parameters.configuration.gain == 4.0
    assert node.parameters.configuration.limits.dtype == float


def test_a_change_arrives_once_and_all_of_it(ros):
    node = start(ros)
    ros.accepts("tunable", gain=5.0)
    assert node.changes == [(5.0, 1.0, "round")]
    ros.accepts("tunable", shape="flat")
    assert node.changes[1:] == [(5.0, 1.0, "flat")]
    assert node.parameters.configuration.changing == (5.0, 1.0, "flat")
    ros.accepts("tunable", gain=6)  # ros2 param set sends a whole number for "6"
    assert node.parameters.configuration.gain == 6.0


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        # What is outside of the range that the description shows, rclpy refuses itself.
        ("gain", -1.0, "Parameter gain out of range Min: 0.0, Max: 1000.0, value: -1.0"),
        ("gain", math.nan, "Parameter gain out of range Min: 0.0, Max: 1000.0, value: nan"),
        ("gain", math.inf, "Parameter gain out of range Min: 0.0, Max: 1000.0, value: inf"),
        ("gain", 0.0, "parameter 'gain' is 0; allowed: a number > 0 and <= 1000"),
        ("gain", 2000, "parameter 'gain' is 2000; allowed: a number > 0 and <= 1000"),
        ("damping", -0.5, "parameter 'damping' is -0.5; allowed: a number >= 0 and <= 9, or -1"),
        ("count", 6, "Parameter count out of range. Min: 1, Max: 5, value: 6"),
        ("pair", [1.0], "parameter 'pair' is [1]; allowed: 2 numbers"),
        ("gain", "high", "parameter 'gain' is 'high'; allowed: a number"),
        ("gain", True, "parameter 'gain' is true; allowed: a number"),
        ("gain", [1.0, 2.0], "parameter 'gain' is [1, 2]; allowed: a number"),
        ("count", 1.5, "parameter 'count' is 1.5; allowed: a whole number"),
        ("enabled", 1, "parameter 'enabled' is 1; allowed: true or false"),
        ("shape", 1, "parameter 'shape' is 1; allowed: a string"),
        ("shape", "oval", "parameter 'shape' is 'oval'; allowed: one of round, flat"),
        # Fine by itself, but not together with the others.
        ("offset", 2.0, "parameter 'offset' is 2; allowed: less than gain"),
        # Fine as a configuration, but not for the node.
        ("damping", 8.5, "parameter 'damping' is 8.5; allowed: at most rate"),
    ],
)
def test_a_bad_change_is_refused_and_the_old_value_stays(ros, name, value, expected):
    node = start(ros, rate=8.0)
    before = node.get_parameter(name).value
    config = node.parameters.configuration
    assert ros.refuses("tunable", **{name: value}) == expected
    assert node.get_parameter(name).value == before
    assert node.parameters.configuration is config
    assert node.changes == []


def test_changes_that_fit_only_together_are_made_at_once(ros):
    node = start(ros)
    assert not ros.set_parameters("tunable", offset=3.0, gain=5.0)[0].successful
    assert node.parameters.configuration.changing == (5.0, 1.0, "round")
    result = node.set_parameters_atomically(overrides({"offset": 6.0, "gain": 8.0}))
    assert result.successful
    assert node.changes == [(5.0, 1.0, "round"), (8.0, 6.0, "round")]
    result = node.set_parameters_atomically(overrides({"shape": "flat", "gain": -1.0}))
    assert not result.successful
    assert node.parameters.configuration.changing == (8.0, 6.0, "round")


@pytest.mark.parametrize(
    ("name", "value"), [("joints", ["a", "b"]), ("limits", [1.0, 2.0]), ("rate", 200.0)]
)
def test_what_is_not_live_is_read_only(ros, name, value):
    node = start(ros)
    assert "read-only" in ros.refuses("tunable", **{name: value})
    assert node.changes == []


def test_a_parameter_cannot_be_deleted(ros):
    node = start(ros, gain=5.0)
    (result,) = node.set_parameters([Parameter("gain", Parameter.Type.NOT_SET)])
    assert result.reason == "parameters cannot be deleted"
    assert node.get_parameter("gain").value == 5.0


@pytest.mark.parametrize(
    ("rule", "error", "line"),
    [
        ("offsset:=1.0", UnknownParameterError, "'offsset'; did you mean 'offset'"),
        ("gain:=[[1.0]]", SettingError, "'gain' is .*; allowed: a number"),
        ("rate:=2001-01-01", SettingError, "'rate' is 2001-01-01; allowed: a number"),
        ("joints:=[]", SettingError, "'joints' is not set; allowed: a list of strings$"),
    ],
)
def test_what_the_command_line_gives_is_checked(ros, rule, error, line):
    remember_arguments(ros.context, ["--ros-args", "-p", rule])
    with pytest.raises(error, match=line):
        start(ros)


def test_parameters_of_other_nodes_may_be_given(ros):
    remember_arguments(ros.context, ["--ros-args", "-p", "pose_kp:=1.0"])
    assert not start(ros).has_parameter("pose_kp")


def test_a_node_without_any_values_asks_for_its_file(ros):
    with pytest.raises(SettingError, match="'joints' is not set.*--params-file FILE$"):
        ros.start(Tunable, {})


def test_parameters_of_others_are_left_alone(ros):
    node = start(ros)
    node.declare_parameter("mine", 1.0)
    ros.accepts("tunable", mine=2.0)
    assert node.changes == []


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"rate": None}, "parameter 'rate' is not set; allowed: a number"),
        ({"joints": None}, "parameter 'joints' is not set; allowed: a list of strings"),
        ({"limits": None}, "parameter 'limits' is not set; allowed: a list of numbers"),
        ({"rate": "fast"}, "parameter 'rate' is 'fast'; allowed: a number"),
        ({"joints": "a"}, "parameter 'joints' is 'a'; allowed: a list of strings"),
        ({"joints": [1, 2]}, "parameter 'joints' is [1, 2]; allowed: a list of strings"),
        ({"limits": 1.0}, "parameter 'limits' is 1; allowed: a list of numbers"),
        ({"limits": ["x"]}, "parameter 'limits' is ['x']; allowed: a list of numbers"),
        ({"limits": [True, False]}, "parameter 'limits' is [true, false]; allowed: a list of "),
        ({"limits": [1.0]}, "parameter 'limits' is [1]; allowed: 2 numbers, one for each of "),
        ({"joints": ["a", "a"]}, "parameter 'joints' is ['a', 'a']; allowed: at least one joint "),
        ({"joints": ["a", ""]}, "parameter 'joints' is ['a', '']; allowed: at least one joint "),
        ({"rate": 0.0}, "parameter 'rate' is 0; allowed: a number > 0 and <= 1000"),
        ({"rate": 2e3}, "parameter 'rate' is 2000; allowed: a number > 0 and <= 1000"),
        ({"rate": math.nan}, "parameter 'rate' is nan; allowed: a number > 0 and <= 1000"),
        ({"limits": [1.0, 0.0]}, "parameter 'limits' is [1, 0]; allowed: finite numbers > 0, one"),
        (
            {"limits": [1.0, 1e13]},
            "parameter 'limits' is [1, 1e+13]; allowed: numbers up to 1e+12 in size",
        ),
        ({"limits": [1.0, math.inf]}, "parameter 'limits' is [1, inf]; allowed: finite numbers"),
        ({"extra": [1.0]}, "parameter 'extra' is [1]; allowed: 2 numbers, one for each of "),
        ({"extra": [1.0, math.nan]}, "parameter 'extra' is [1, nan]; allowed: numbers, not NaN"),
        ({"joints": []}, "parameter 'joints' is []; allowed: at least one joint "),
        ({"gain": 0.5}, "parameter 'offset' is 1; allowed: less than gain"),
    ],
)
def test_a_node_does_not_start_with_bad_values(shared_ros, changed, expected):
    with pytest.raises(SettingError) as refusal:
        start(shared_ros, **changed)
    assert str(refusal.value).startswith(expected)
    assert "\n" not in str(refusal.value)
    assert refusal.value.name in expected


def test_descriptions_tell_what_may_change_and_to_what(ros):
    node = start(ros)
    gain = node.describe_parameter("gain")
    assert (gain.description, gain.read_only) == ("1/s", False)
    assert (gain.floating_point_range[0].from_value, gain.floating_point_range[0].to_value) == (
        0.0,
        1e3,
    )
    assert gain.additional_constraints == "a number > 0 and <= 1000"
    assert node.describe_parameter("damping").floating_point_range[0].from_value == -1.0
    assert node.describe_parameter("count").integer_range[0].to_value == 5
    assert node.describe_parameter("rate").read_only
    for name, expected in (
        ("limits", "finite numbers > 0, one for each of 'joints'"),
        ("extra", "numbers, one for each of 'joints', or none"),
        ("filled", "numbers, one for each of 'joints', or none"),
        ("pair", "2 numbers"),
        ("shape", "one of round, flat"),
        ("enabled", ""),
    ):
        assert node.describe_parameter(name).additional_constraints == expected
    assert list(node.get_parameter("pair").value) == [1.0, 2.0]


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (np.array([1.0, 2.5]), "[1, 2.5]"),
        (array("d", [1.0, 2.5]), "[1, 2.5]"),
        (("a", "b"), "['a', 'b']"),
        (0.1, "0.1"),
        (7, "7"),
        (False, "false"),
    ],
)
def test_values_are_shown_as_they_are_written(value: Any, shown: str):
    assert str(SettingError("p", value, "x")) == f"parameter 'p' is {shown}; allowed: x"


def test_locked_joints():
    given = {"robot_description": "", "joints": ["z"], "torque_max": [1.0]}
    given |= {"position_min": [-1.0], "position_max": [1.0]}
    given |= {"locked_joints": ["x", "y"], "locked_positions": [0.5, -1.0]}
    assert read(RobotConfiguration, given).locked == {"x": 0.5, "y": -1.0}
    for bad in ([0.5], [0.5, math.nan], [0.5, math.inf]):
        with pytest.raises(SettingError, match="'locked_positions'"):
            read(RobotConfiguration, given | {"locked_positions": bad})
