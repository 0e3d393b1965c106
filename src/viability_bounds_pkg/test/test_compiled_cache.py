"""A compiled function is never older than the functions of other files that it calls."""

import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def test_a_change_in_a_called_file_is_noticed(tmp_path):
    package = tmp_path / "kernels"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from viability_bounds_pkg.compiled_cache import keep_compiled\n"
        "NOTHING_COMPILED = keep_compiled(__path__[0])\n"
    )
    (package / "outer.py").write_text(
        "from numba import njit\nfrom kernels.inner import inner\n\n"
        "@njit(cache=True)\ndef outer(x):\n    return 10.0 * inner(x)\n"
    )

    def value(factor):
        (package / "inner.py").write_text(
            "from numba import njit\n\n"
            f"@njit(cache=True)\ndef inner(x):\n    return {factor} * x\n"
        )
        code = (
            "import kernels; from kernels.outer import outer\n"
            "print(outer(1.0), len(outer.stats.cache_hits), kernels.NOTHING_COMPILED)"
        )
        run = subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONPATH": f"{tmp_path}:{PACKAGE}", "PATH": "/usr/bin:/bin"},
            capture_output=True,
            text=True,
            check=True,
        )
        result, hits, nothing = run.stdout.split()
        assert (nothing == "True") == (hits == "0")
        return float(result), hits == "1"

    assert value(1.0) == (10.0, False)
    assert value(1.0) == (10.0, True)
    assert value(3.0) == (30.0, False)
    assert list((package / "__pycache__").glob("outer*.nbc"))
