#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Creates the environment for all other scripts, and activates it. Source it:
#
#     source scripts/setup.sh
#
# With ROS 2 Jazzy sourced, it makes .venv on top of that (system site packages) and adds what is
# missing. Without, it installs the Jazzy wheels into .venv. Then it builds the three packages
# with colcon, and compiles what Numba would otherwise compile at the first start of a node. What
# is done already is not done again.

_usage() {
    cat <<'USAGE'
usage: source scripts/setup.sh

Makes .venv with what the packages need, builds the packages into install/, compiles what Numba
compiles, and activates all of it in this shell. What is done already is not done again.

  PYTHON    the Python to make .venv of (default: python3)
USAGE
}

_setup() {
    local root python venv stamp wanted inputs
    root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
    python="${PYTHON:-python3}"
    venv="$root/.venv"

    if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
        echo "setup: Python 3.10 or newer is needed; '$python' is" \
            "$("$python" --version 2>&1 || true). Set PYTHON to another one." >&2
        return 1
    fi

    local ros=wheels
    if [ "${ROS_DISTRO:-}" = jazzy ] && "$python" -c 'import rclpy' 2>/dev/null; then
        ros=sourced
    elif [ -n "${ROS_DISTRO:-}" ] && [ "$ROS_DISTRO" != jazzy ]; then
        echo "setup: ROS 2 '$ROS_DISTRO' is sourced, but this is for Jazzy;" \
            "open a shell without it." >&2
        return 1
    fi

    # The inputs of an installation; when one of them changes, it is repeated.
    stamp="$venv/.installed"
    inputs="$(cat "$root/requirements/common.txt" "$root/requirements/$ros.txt" \
        "$root/requirements/constraints.txt"; echo "$ros"; "$python" --version)"
    wanted="$(printf '%s' "$inputs" | sha256sum | cut -d' ' -f1)"
    if [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]; then
        _install || return 1
        printf '%s' "$wanted" >"$stamp"
    fi

    # shellcheck disable=SC1091
    source "$venv/bin/activate"
    _build || return 1
    # shellcheck disable=SC1091
    source "$root/install/local_setup.bash"
    _compile
}

_install() {
    local options=()
    if [ "$ros" = sourced ]; then
        echo "setup: ROS 2 Jazzy is sourced; making .venv on top of it" >&2
        options+=(--system-site-packages)
    else
        if [ "${ROS_DISTRO:-}" = jazzy ]; then
            echo "setup: ROS 2 Jazzy is sourced, but '$python' cannot import its rclpy" >&2
        fi
        echo "setup: no usable ROS 2; installing the Jazzy wheels into .venv" >&2
    fi
    if ! "$python" -m venv --clear "${options[@]}" "$venv"; then
        echo "setup: '$python -m venv' failed; on Ubuntu: sudo apt install python3-venv" >&2
        return 1
    fi
    cp "$root/requirements/constraints.txt" "$venv/constraints.txt"
    if [ "$ros" = sourced ]; then
        # ROS' message packages are compiled for the system's NumPy, so that version is kept.
        local numpy
        numpy="$("$python" -c 'import numpy; print(numpy.__version__)')" || return 1
        sed -i "s/^numpy==.*/numpy==$numpy/" "$venv/constraints.txt"
    fi
    local pip=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check
        --constraint "$venv/constraints.txt")
    if ! "${pip[@]}" -r "$root/requirements/common.txt" -r "$root/requirements/$ros.txt"; then
        echo "setup: installing packages failed (is there a network?); run it again to retry" >&2
        return 1
    fi
    _install_pybullet
}

_install_pybullet() {
    if "$venv/bin/python" -c 'import pybullet' 2>/dev/null; then
        return 0
    fi
    if ! "$venv/bin/python" -c 'import sys; sys.exit(sys.version_info >= (3, 12))'; then
        echo "setup: PyBullet has no wheel for this Python; building it takes minutes and g++." \
            "On Ubuntu 'sudo apt install python3-pybullet' is faster." >&2
    fi
    if ! "${pip[@]}" pybullet; then
        echo "setup: installing PyBullet failed; install g++, or python3-pybullet" >&2
        return 1
    fi
}

_build() {
    # Sources are symlinked, so only changes of these files need a new build.
    local built="$root/install/.built" now
    now="$(cat "$root"/src/*/setup.py "$root"/src/*/setup.cfg "$root"/src/*/package.xml \
        "$root/colcon.meta" "$stamp" <(cd "$root" && find config/ | sort) |
        sha256sum | cut -d' ' -f1) $root"
    if [ "$(cat "$built" 2>/dev/null)" = "$now" ]; then
        return 0
    fi
    echo "setup: building the packages with colcon" >&2
    if ! (cd "$root" && colcon --log-base "$root/log" build --symlink-install \
        --event-handlers console_cohesion- console_start_end- summary- \
        --metas "$root/colcon.meta" >"$root/.venv/build.log" 2>&1); then
        cat "$root/.venv/build.log" >&2
        return 1
    fi
    printf '%s' "$now" >"$built"
}

_compile() {
    local compiled="$root/install/.compiled" now
    now="$(find "$root/src" "$root/scripts/compile.py" \
        -path '*/test/*' -prune -o \( -name '*.py' -o -name '*.yaml' \) -print0 |
        LC_ALL=C sort -z | xargs -0 sha256sum | cat - "$stamp" | sha256sum)"
    if [ "$(cat "$compiled" 2>/dev/null)" = "$now" ]; then
        return 0
    fi
    if ! PYTHONPATH="$root/reproduction:${PYTHONPATH:-}" python "$root/scripts/compile.py"; then
        echo "setup: compiling ahead failed; the nodes compile when they start" >&2
        return 0
    fi
    printf '%s' "$now" >"$compiled"
}

# Scripts source it with their own arguments in place.
if [ -z "${BASH_SOURCE[1]:-}" ] && [[ "${1:-}" =~ ^(-h|--help)$ ]]; then
    _usage
    unset -f _usage _setup _install _install_pybullet _build _compile
    return 0 2>/dev/null || exit 0
fi

# One at a time: two shells may source this at once.
exec {_lock}>"$(dirname "${BASH_SOURCE[0]}")/../.setup.lock"
flock "$_lock"
_setup
_status=$?
exec {_lock}>&-
unset -f _usage _setup _install _install_pybullet _build _compile
unset _lock
(exit $_status)
