# SPDX-License-Identifier: Apache-2.0
"""Files of limits are written whole or not at all."""

from __future__ import annotations

import os
from decimal import ROUND_DOWN, ROUND_UP

import numpy as np
import pytest
import yaml

from viability_bounds_pkg.cli import limits_file
from viability_bounds_pkg.testing.executables import room_on_disk


def parameters_in(text):
    return yaml.safe_load(text)["/**/bounds_node"]["ros__parameters"]


def test_existing_file_is_replaced_whole(tmp_path):
    path = tmp_path / "limits.yaml"
    path.write_text("old")
    path.chmod(0o640)
    before = path.stat().st_ino
    limits_file.write_whole(path, "new")
    assert path.read_text() == "new"
    assert path.stat().st_ino != before  # another file took its place
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["limits.yaml"]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch, broken, error):
    path = tmp_path / "limits.yaml"
    path.write_text("old")

    def fail(*arguments):
        raise error

    monkeypatch.setattr(limits_file.os, broken, fail)
    with pytest.raises(type(error)):
        limits_file.write_whole(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["limits.yaml"]


def test_a_write_protected_file_is_left_alone(tmp_path, monkeypatch):
    path = tmp_path / "limits.yaml"
    path.write_text("old")
    access = os.access
    # The permissions themselves do not stop root, who may be running this.
    monkeypatch.setattr(
        limits_file.os, "access", lambda p, mode: mode != os.W_OK and access(p, mode)
    )
    with pytest.raises(PermissionError, match="write-protected"):
        limits_file.check_writable(path)
    assert os.listdir(tmp_path) == ["limits.yaml"]


def test_checking_leaves_nothing_behind(tmp_path):
    limits_file.check_writable(tmp_path / "limits.yaml")
    assert os.listdir(tmp_path) == []


def test_a_link_keeps_pointing_to_the_file_written(tmp_path):
    target, link = tmp_path / "limits.yaml", tmp_path / "link.yaml"
    link.symlink_to(target)
    limits_file.write_whole(link, "new")
    assert link.is_symlink() and target.read_text() == "new"


def test_written_numbers_err_to_the_safe_side():
    values = np.array([3.0, -3.0, 5.08769, -5.08769, 0.00123456, 1741.837, 15.0, 0.3, 0.0])
    down = limits_file.rounded(values, ROUND_DOWN)
    up = limits_file.rounded(values, ROUND_UP)
    np.testing.assert_array_equal(
        down, [3.0, -3.0, 5.087, -5.087, 0.001234, 1741.0, 15.0, 0.3, 0.0]
    )
    np.testing.assert_array_equal(up, [3.0, -3.0, 5.088, -5.088, 0.001235, 1742.0, 15.0, 0.3, 0.0])
    text = limits_file.overlay({"acceleration_min": down}, ["note"])
    assert text.startswith("# note\n")
    np.testing.assert_array_equal(parameters_in(text)["acceleration_min"], down)


def test_a_disk_that_is_full_is_told_with_the_name_of_the_file(tmp_path):
    path = tmp_path / "limits.yaml"
    path.write_text("old")
    with room_on_disk(1000), pytest.raises(OSError, match=f"{path} cannot be written: File too"):
        limits_file.write_whole(path, "x" * 5000)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["limits.yaml"]
