# SPDX-License-Identifier: Apache-2.0
"""Arguments after ``--ros-args``: checked before rcl reads them, whose errors name no remedy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.user_input.known_names import graph_names
from viability_bounds_pkg.user_input.parameter_files import check_value
from viability_bounds_pkg.user_input.yaml_file import load_yaml

_WITH_VALUE = {
    "-p": "-p",
    "--param": "-p",
    "-r": "-r",
    "--remap": "-r",
    "--params-file": "--params-file",
    "--log-level": "--log-level",
    "--log-config-file": "--log-config-file",
    "--log-file-name": "--log-file-name",
    "-e": "-e",
    "--enclave": "-e",
}
"""Flags that a value follows, and their short form."""

_ALONE = {
    f"--{switch}-{logs}-logs"
    for switch in ("enable", "disable")
    for logs in ("rosout", "stdout", "external-lib")
}
_LEVELS = ("debug", "info", "warn", "error", "fatal", "unset")
_DOMAIN_MAX = 232
_OF_ROS = frozenset({"tf", "tf_static", "rosout", "parameter_events"})


class RosArgumentError(ArmSafetyError, ValueError):
    """A ROS argument, or variable of the environment, that cannot be used."""


def ros_rules(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield flags in their short form with their values, in their order.

    Args:
        arguments: of the command line.
    """
    ros, flag = False, ""
    for word in arguments:
        if flag:
            yield flag, word
            flag = ""
        elif word in ("--ros-args", "--"):
            ros = word == "--ros-args"
        elif ros:
            flag = _WITH_VALUE.get(word, "")


def check_ros_arguments(arguments: Sequence[str], environment: Mapping[str, str]) -> None:
    """Check what rcl would not understand, or ignore.

    Args:
        arguments: of the command line.
        environment: variables of the process.

    Raises:
        RosArgumentError: an argument or variable of the environment that cannot be used.
        YamlError: the value of a parameter is no YAML.
        ParameterFileError: the value of a parameter is a list of several types.
    """
    domain = environment.get("ROS_DOMAIN_ID", "") or "0"
    if not domain.isdecimal() or int(domain) > _DOMAIN_MAX:
        raise RosArgumentError(
            f"ROS_DOMAIN_ID is '{domain}'; allowed: a whole number from 0 to {_DOMAIN_MAX}"
        )
    _check_flags(arguments)
    for flag, value in ros_rules(arguments):
        if flag == "-p":
            name, separator, text = value.partition(":=")
            if not separator or not name:
                hint = value.replace("=", ":=", 1) if "=" in value else f"{value}:=VALUE"
                raise RosArgumentError(f"'-p {value}' is no NAME:=VALUE; write '-p {hint}'")
            if not text.strip():
                raise RosArgumentError(
                    f"'-p {value}' has no value; an empty string is written \"{name}:=''\", "
                    "quotes included"
                )
            check_value(load_yaml(text, f"'-p {value}'"), f"parameter '{name}'")
        elif flag == "-r":
            _check_remapping(value)
        elif flag == "--log-level":
            level = value.rpartition(":=")[2].lower()
            if level not in _LEVELS:
                raise RosArgumentError(
                    f"'--log-level {value}': allowed: one of {', '.join(_LEVELS)}"
                    + did_you_mean(level, _LEVELS)
                )


def _check_flags(arguments: Sequence[str]) -> None:
    ros, flag = False, ""
    for word in arguments:
        if flag and not word.startswith("--"):
            flag = ""
        elif flag:
            break
        elif word in ("--ros-args", "--"):
            ros = word == "--ros-args"
        elif ros and word in _WITH_VALUE:
            flag = word
        elif ros and word not in _ALONE:
            hint = did_you_mean(word, {*_WITH_VALUE, *_ALONE} if word.startswith("-") else ())
            raise RosArgumentError(f"unknown ROS argument '{word}'{hint}")
    if flag:
        raise RosArgumentError(f"ROS argument '{flag}' has no value")


def _check_remapping(rule: str) -> None:
    source, separator, target = rule.partition(":=")
    if not separator or not source or not target:
        hint = rule.replace("=", ":=", 1) if "=" in rule else f"{rule}:=NEW"
        raise RosArgumentError(f"'-r {rule}' is no OLD:=NEW; write '-r {hint}'")
    name = source.rpartition(":")[2]
    if name == "__ns" and not target.startswith("/"):
        raise RosArgumentError(
            f"'-r {rule}': a namespace begins with a slash; write '-r __ns:=/{target}'"
        )
    if name in ("__node", "__name") and not target.replace("_", "a").isalnum():
        raise RosArgumentError(
            f"'-r {rule}': the name of a node has letters, digits and underscores only"
        )
    if not is_known_remapping(rule):
        known = graph_names("topic") | graph_names("service")
        if hint := did_you_mean(name.rpartition("/")[2], known):
            raise RosArgumentError(f"'-r {rule}': no node has '{name}'{hint}")


def is_known_remapping(rule: str) -> bool:
    """Return whether the old name of a rule OLD:=NEW is one that a node of this project has."""
    name = rule.partition(":=")[0].rpartition(":")[2].rpartition("/")[2]
    return name.startswith("__") or name in (
        graph_names("topic") | graph_names("service") | _OF_ROS
    )
