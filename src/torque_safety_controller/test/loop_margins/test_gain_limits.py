# SPDX-License-Identifier: Apache-2.0
"""The largest gains that a robot bears, and the tool that prints them."""

from __future__ import annotations

import numpy as np
import pytest

from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.tools.gain_limits import GainCheck, main
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

BOUNDS, CONTROLLER = (
    read_config("talos_left_arm", node) for node in ("bounds_node", "controller_node")
)
ARM = read(BoundsConfiguration, BOUNDS)
N = len(ARM.joints)
KP, KD = 900.0, 50.0  # of the file
MARGIN, LIMIT_MARGIN = 0.5, 0.3  # that gains are to leave


def check(predicted=False, **declared) -> GainCheck:
    given = {"use_estimated_states": predicted, "position_margin": 1e-6}
    calm = {"acceleration_disturbance": [5.0] * N}
    robot = read(BoundsConfiguration, BOUNDS | calm | declared | given)
    return GainCheck(read(ControllerConfiguration, CONTROLLER | given), robot)


def limits(**changed):
    return {limit.name: limit for limit in check(**changed).limits()}


@pytest.fixture(scope="module")
def ideal():
    """Limits of an arm without delay or errors."""
    return limits()


def test_two_periods_of_delay_halve_the_integral_gain_and_a_prediction_gives_it_back(ideal):
    """With 100 1/s TALOS was in a lasting limit cycle on a joint limit, with 50 it was not."""
    assert not any(limit.exceeded for limit in ideal.values())
    late = limits(delay=2)
    assert late["integral_lambda"].exceeded
    assert 45.0 < late["integral_lambda"].limit < 55.0
    assert not late["pose_kp"].exceeded
    predicted = limits(delay=2, predicted=True)
    assert not predicted["integral_lambda"].exceeded
    assert predicted["bounds_dt_factor"].limit < late["bounds_dt_factor"].limit


def test_a_limit_is_where_the_margin_is():
    late = check(delay=2)
    found = {limit.name: limit.limit for limit in late.limits()}
    gain, kp, kd = (found[name] for name in ("integral_lambda", "pose_kp", "pose_kd"))
    assert late.margin(KP, KD, 0.99 * gain) > MARGIN > late.margin(KP, KD, 1.01 * gain)
    assert kp / KP == pytest.approx((kd / KD) ** 2)
    assert late.margin(0.98 * kp, 0.99 * kd, 0.0) > MARGIN
    assert late.margin(1.02 * kp, 1.01 * kd, 0.0) < MARGIN
    predicted = check(delay=2, predicted=True)
    (factor,) = (limit.limit for limit in predicted.limits() if limit.name == "bounds_dt_factor")
    assert predicted.limit_margin(1.01 * factor) > LIMIT_MARGIN
    assert predicted.limit_margin(0.99 * factor) < LIMIT_MARGIN


def test_jitter_counts_as_the_longer_delay():
    jitter, longer = limits(delay=1, delay_jitter=1), limits(delay=2)
    for name, limit in longer.items():
        assert jitter[name].limit == pytest.approx(limit.limit, rel=1e-3)


def test_disturbances_are_not_estimated_faster_than_predicted_commands_act():
    """As the observer sees them: predicted velocities, whose commands under way did not act."""
    delay, wanted, acted = 5, 6.0, -6.0
    late = limits(delay=delay, predicted=True)["disturbance_time"]
    assert late.exceeded
    assert (late.value, late.limit) == (0.003, pytest.approx(0.005))
    for time, within in ((late.limit, True), (0.5 * late.limit, False)):
        observer = Disturbance(1, time)
        v = np.zeros(1)
        for change in (0.0, wanted * 1e-3, wanted * 1e-3 + delay * (acted - wanted) * 1e-3):
            v = v + change
            observer.observe(v, np.full(1, wanted), 1e-3, np.full(1, 1e3), np.eye(1))
        assert (abs(observer.estimate[0]) <= abs(acted - wanted)) == within
    assert not limits(delay=5)["disturbance_time"].exceeded


# The tool


def run(robot, text=None, folder=None) -> int:
    """Run it for a robot with further declarations."""
    files = [config_folder() / f"{robot}.yaml"]
    if text is not None:
        files.append(folder / "declared.yaml")
        files[1].write_text(f"/**/bounds_node:\n  ros__parameters: {{{text}}}\n")
    return main([word for path in files for word in ("--params-file", str(path))])


@pytest.mark.parametrize("robot", ["baxter_left_arm", "panda", "talos_left_arm"])
def test_ideal_robots_bear_the_gains_of_their_files(robot, capsys):
    assert run(robot) == 0
    assert "exceeded" not in capsys.readouterr().out


def test_the_tool_prints_the_largest_gains_and_says_what_is_exceeded(tmp_path, capsys):
    assert run("talos_left_arm", "delay: 2", tmp_path) == 1
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert rows["integral_lambda"].split()[:4] == ["integral_lambda", "100", "<=", "49.28"]
    assert rows["integral_lambda"].endswith("exceeded")
    assert rows["bounds_dt_factor"].endswith("exceeded")
    assert not rows["pose_kp"].endswith("exceeded")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("delay: -1", "parameter 'delay' is -1"),
        ("dellay: 1", "unknown parameter 'dellay'; did you mean 'delay'?"),
    ],
)
def test_what_is_wrong_in_a_file_gets_one_line(tmp_path, capsys, text, line):
    assert run("talos_left_arm", text, tmp_path) == 1
    said = capsys.readouterr().err
    assert said.startswith("gain_limits: ")
    assert line in said
    assert said.count("\n") == 1
