# SPDX-License-Identifier: Apache-2.0
"""Jogs by keys: what the user is told, and how it ends."""

import os

from torque_safety_controller.remote.teleop import Teleop, _loop


def make(ros):
    return Teleop(ros.probe, ["a", "b"], ("base", "hand"), (0.1, 0.5, 0.3))


def test_keys_that_nobody_hears_are_told_once(ros):
    teleop = make(ros)
    assert [teleop.press(key, 0.0) for key in "ww1"] == ["no controller is heard", "", ""]


def test_it_ends_with_its_terminal(ros):
    terminal, keyboard = os.pipe()
    os.write(keyboard, b"t")
    os.close(keyboard)
    _loop(make(ros), terminal)
    os.close(terminal)
