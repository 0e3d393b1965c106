# SPDX-License-Identifier: Apache-2.0
"""Files of limits are written whole or not at all."""

import os
from decimal import ROUND_DOWN, ROUND_UP

import numpy as np
import pytest

from viability_bounds_pkg.cli import limits_file
from viability_bounds_pkg.testing.executables import room_on_disk


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "limits.yaml"
    path.write_text("old")
    return path


def test_existing_file_is_replaced_whole(path):
    path.chmod(0o640)
    before = path.stat().st_ino
    limits_file.write_whole(path, "new")
    assert path.read_text() == "new"
    assert path.stat().st_ino != before  # another file took its place
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(path.parent) == ["limits.yaml"]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_an_interrupted_write_leaves_the_old_file(path, monkeypatch, broken):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(limits_file.os, broken, interrupt)
    with pytest.raises(KeyboardInterrupt):
        limits_file.write_whole(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["limits.yaml"]


def test_a_disk_that_is_full_is_told_with_the_name_of_the_file(path):
    with room_on_disk(1000), pytest.raises(OSError, match=f"{path} cannot be written: File too"):
        limits_file.write_whole(path, "x" * 5000)
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["limits.yaml"]


def test_a_write_protected_file_is_left_alone(path, monkeypatch):
    # The permissions themselves do not stop root, who may be running this.
    access = os.access
    monkeypatch.setattr(
        limits_file.os, "access", lambda p, mode: mode != os.W_OK and access(p, mode)
    )
    with pytest.raises(PermissionError, match="write-protected"):
        limits_file.check_writable(path)


def test_a_link_keeps_pointing_to_the_file_written(path):
    link = path.with_name("link.yaml")
    link.symlink_to(path)
    limits_file.write_whole(link, "new")
    assert link.is_symlink() and path.read_text() == "new"


def test_written_numbers_err_to_the_safe_side():
    values = np.array([3.0, -3.0, 5.08769, -5.08769, 0.00123456, 1741.837, 0.0])
    down, up = limits_file.rounded(values, ROUND_DOWN), limits_file.rounded(values, ROUND_UP)
    assert down.tolist() == [3.0, -3.0, 5.087, -5.087, 0.001234, 1741.0, 0.0]
    assert up.tolist() == [3.0, -3.0, 5.088, -5.088, 0.001235, 1742.0, 0.0]
