#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Runs the tests, setting itself up first.
set -eu
case "${1:-}" in
-h | --help)
    cat <<'USAGE'
usage: bash scripts/test.sh [options of pytest]

  bash scripts/test.sh                  all tests but the long ones, in several processes
  bash scripts/test.sh -k viability     some of them, in one
  bash scripts/test.sh -m long -n 3     whole scenarios and commands, seconds each
  bash scripts/test.sh -m packaging     those of set-up and of copies of packages
  bash scripts/test.sh -n 2             in so many processes; 0 for this one
  bash scripts/test.sh --hypothesis-profile=explore    with other examples than last time

`python -m pytest --help`, after `source scripts/setup.sh`, lists the options.
USAGE
    exit 0
    ;;
esac
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/environment.sh
source "$root/scripts/environment.sh"
cd "$root"
# What only tests need, once.
if [ ! .venv/.tests -nt requirements/tests.txt ]; then
    echo "test: installing and compiling what only tests need" >&2
    python -m pip install --quiet --disable-pip-version-check --no-compile \
        --constraint .venv/constraints.txt -r requirements/tests.txt
    PYTHONDONTWRITEBYTECODE= PYTHONPATH="$root/reproduction:${PYTHONPATH:-}" \
        python scripts/compile.py --all
    touch .venv/.tests
fi
# So that what is compiled of tests and sources to be imported is kept for the other processes.
unset PYTHONDONTWRITEBYTECODE
# One process more than cores, because some tests wait.
[ $# -gt 0 ] || set -- -n "$(($(nproc) + 1))"
exec python -m pytest "$@"
