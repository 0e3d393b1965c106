# SPDX-License-Identifier: Apache-2.0
"""What is compiled is never older than the functions of other files that it calls."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from viability_bounds_pkg.compiled import _LockedFile

PACKAGE = Path(__file__).resolve().parents[2]


def test_a_change_in_a_called_file_of_a_subfolder_is_noticed(tmp_path):
    package = tmp_path / "arm"
    room = package / "rooms" / "kernel"
    room.mkdir(parents=True)
    (package / "outer.py").write_text(
        "from viability_bounds_pkg.compiled import compiled\n"
        "from arm.rooms.kernel.inner import inner\n\n"
        "@compiled\ndef outer(x):\n    return 10.0 * inner(x)\n"
    )

    def value(factor):
        (room / "inner.py").write_text(
            "from viability_bounds_pkg.compiled import compiled\n\n"
            f"@compiled\ndef inner(x):\n    return {factor} * x\n"
        )
        code = (
            "from arm.outer import outer\nprint(outer(1.0), sum(outer.stats.cache_hits.values()))"
        )
        run = subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONPATH": f"{tmp_path}:{PACKAGE}", "PATH": "/usr/bin:/bin"},
            capture_output=True,
            text=True,
            check=True,
        )
        result, hits = run.stdout.split()
        return float(result), hits == "1"

    assert value(1.0) == (10.0, False)
    assert value(1.0) == (10.0, True)
    assert value(3.25) == (32.5, False)
    assert value(3.25) == (32.5, True)
    assert list((package / "__pycache__").glob("outer*.nbc"))


def test_importing_writes_nothing_and_changes_no_setting(tmp_path):
    code = (
        "import numba\n"
        "before = numba.config.CACHE_DIR\n"
        "import viability_bounds_pkg.viability\n"
        "assert numba.config.CACHE_DIR == before\n"
    )
    cache = tmp_path / "cache"
    subprocess.run(
        [sys.executable, "-B", "-c", code],
        env={"PYTHONPATH": str(PACKAGE), "PATH": "/usr/bin:/bin", "NUMBA_CACHE_DIR": str(cache)},
        check=True,
    )
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_what_is_kept_at_the_same_time_is_not_mixed_up(tmp_path):
    def keep(key):
        file = _LockedFile(tmp_path, "function", "sources")
        file.save(key, {"code": key})

    with ThreadPoolExecutor(16) as pool:
        list(pool.map(keep, range(100)))
    file = _LockedFile(tmp_path, "function", "sources")
    assert [file.load(key) for key in range(100)] == [{"code": key} for key in range(100)]


def test_code_of_other_sources_is_not_run_when_writing_was_interrupted(tmp_path, monkeypatch):
    old, new = (_LockedFile(tmp_path, "function", sources) for sources in ("old", "new"))
    old.save("types", "old code")

    def interrupted(name, data):
        save(name, data)
        raise KeyboardInterrupt

    save = new._save_data
    monkeypatch.setattr(new, "_save_data", interrupted)
    with pytest.raises(KeyboardInterrupt):
        new.save("types", "new code")
    assert new.load("types") is None
    assert old.load("types") is None


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_files_are_replaced(tmp_path, ending):
    file = _LockedFile(tmp_path, "function", "sources")
    file.save("types", "code")
    (damaged,) = tmp_path.glob(f"*.{ending}")
    damaged.write_bytes(damaged.read_bytes()[:-3])
    assert file.load("types") is None
    file.save("types", "code")
    assert file.load("types") == "code"
