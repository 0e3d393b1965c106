#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Set-up, node tests and a demo on a system like Ubuntu 24.04 with ROS 2 Jazzy sourced:
#
#     bash test/ubuntu_jazzy.sh                    all of it
#     bash test/ubuntu_jazzy.sh --set-up FOLDER    the set-up only, of a copy in an empty folder
#     bash test/ubuntu_jazzy.sh FOLDER             the rest of it there
#
# The system is a copy of a Python 3.12 with NumPy 1.26.4 and PyBullet, as apt has them, and with
# ROS' wheels in a folder of their own, found by the variables that sourcing sets. It is kept in the
# user's cache folder, because building PyBullet takes minutes.
#
# Python 3.12: PYTHON312, or python3.12 on PATH. Ends with 77 where there is none.
set -euo pipefail
root="$(cd "$(dirname "$0")/.." && pwd)"
numpy=1.26.4

say() { echo "ubuntu_jazzy: $*"; }

stage() {
    local name="$1" start=$SECONDS status
    shift
    set +e # `if` and `||` would switch it off inside, too
    (set -e; "$@") >"$log" 2>&1
    status=$?
    set -e
    if [ "$status" -ne 0 ]; then
        cat "$log"
        say "$name: FAILED after $((SECONDS - start)) s"
        exit 1
    fi
    say "$name: $((SECONDS - start)) s"
}

# Prints the folder of a Python 3.12. A system's own is spread over /usr and cannot be copied.
find_python() {
    local candidate
    for candidate in "${PYTHON312:-}" python3.12 "$(pyenv prefix 3.12 2>/dev/null)/bin/python3.12"; do
        [ -n "$candidate" ] || continue
        "$candidate" -c 'import sys
if sys.version_info[:2] != (3, 12) or sys.base_prefix.startswith("/usr"):
    sys.exit(1)
print(sys.base_prefix)' 2>/dev/null && return 0
    done
    return 1
}

make_system() {
    local python="$system/bin/python3.12"
    rm -rf "$system"
    mkdir -p "$system"
    tar -C "$prefix" -c --exclude=site-packages --exclude=__pycache__ \
        --exclude=lib/python3.12/test --exclude='*.a' bin include lib | tar -C "$system" -x
    "$python" -m ensurepip
    sed "s/^numpy==.*/numpy==$numpy/" "$root/requirements/constraints.txt" >"$system/constraints.txt"
    local pip=("$python" -m pip install --disable-pip-version-check --no-warn-script-location
        --constraint "$system/constraints.txt")
    "${pip[@]}" numpy PyYAML
    "${pip[@]}" --prefix "$ros" -r "$root/requirements/wheels.txt"
    "${pip[@]}" pybullet
    printf '%s' "$key" >"$system/.complete"
}

# ROS has a plugin for pytest, with hooks that new versions of pytest do not know.
add_pytest_plugin() {
    mkdir -p "$1/launch_testing-1.dist-info"
    printf 'Name: launch_testing\nVersion: 1\n' >"$1/launch_testing-1.dist-info/METADATA"
    printf '[pytest11]\nlaunch_testing = launch_testing\n' \
        >"$1/launch_testing-1.dist-info/entry_points.txt"
    printf 'def pytest_pycollect_makemodule(path, parent):\n    pass\n' >"$1/launch_testing.py"
}

# As /opt/ros/jazzy/setup.bash does.
source_ros() {
    export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
    export AMENT_PREFIX_PATH="$ros"
    export PYTHONPATH="$ros/lib/python3.12/site-packages"
    export LD_LIBRARY_PATH="$ros/lib:$(printf '%s:' "$PYTHONPATH"/ros_*.libs)"
    unset VIRTUAL_ENV
    add_pytest_plugin "$work/plugin"
    PYTHONPATH+=":$work/plugin"
}

set_up() {
    # As a user's shell: some variables are not set, some commands fail.
    (set +eu; source scripts/setup.sh)
}

check_environment() {
    local interpreter version
    interpreter="$(sed -n '1s/^#!//p' install/viability_bounds_pkg/lib/viability_bounds_pkg/bounds_node)"
    version="$("$interpreter" -c 'import numpy; print(numpy.__version__, numpy.__file__)')"
    echo "NumPy of the nodes: $version"
    [[ "$version" == "$numpy $system/"* ]]
    [ -z "$(find .venv -maxdepth 5 -iname 'numpy-*')" ] # none of its own
    # What cmeel-boost asks for is known not to matter; nothing else may be inconsistent.
    .venv/bin/python -m pip check >"$work/consistency" || true
    cat "$work/consistency"
    [ "$(grep -vc '^cmeel-boost .* has requirement numpy' "$work/consistency")" -eq 0 ]
}

if ! prefix="$(find_python)"; then
    say "no Python 3.12 that can be copied; skipped (set PYTHON312 to one)"
    exit 77
fi
key="$(cat "$root"/requirements/{wheels,constraints}.txt <(declare -f make_system; echo "$prefix") |
    sha256sum)"
system="${XDG_CACHE_HOME:-$HOME/.cache}/viability_bounds/ubuntu_jazzy"
ros="$system/opt/ros/jazzy"
parts="set-up tests" # of all of it
if [ "${1:-}" = --set-up ]; then
    parts=set-up work="$(realpath "$2")"
elif [ $# -gt 0 ]; then
    parts=tests work="$(realpath "$1")"
else
    work="$(mktemp -d)"
    trap 'rm -rf "$work"' EXIT
fi
log="$work/log"
trap 'exit 130' INT TERM
# Nobody makes it anew while another run uses it.
mkdir -p "$(dirname "$system")"
exec {lock}>"$system.lock"
flock "$lock"
if [ "$(cat "$system/.complete" 2>/dev/null)" = "$key" ]; then
    say "system: kept from before"
else
    stage "system (Python, NumPy $numpy, ROS' wheels, PyBullet from source)" make_system
fi
flock --shared "$lock"

source_ros
export PYTHON="$system/bin/python3.12"
if [[ "$parts" == *set-up* ]]; then
    mkdir "$work/copy"
    git -C "$root" ls-files -z | tar -C "$root" --null -T - -c | tar -C "$work/copy" -x
    cd "$work/copy"
    stage "set-up" set_up
    grep -v compiling "$log"
fi
[[ "$parts" == *tests* ]] || exit 0
cd "$work/copy"
stage "set-up again" set_up
stage "NumPy and consistency" check_environment
cat "$log"
stage "tests of the nodes" bash scripts/test.sh -q -n "$(nproc)" -p no:cacheprovider \
    src/*/test/node src/*/test/ros test/installation/test_startup.py
tail -n 1 "$log"
stage "demo in lockstep" bash scripts/demo.sh --lockstep --out "$work/demo"
stage "NumPy after all" check_environment
