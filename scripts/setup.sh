#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Creates the environment for all other scripts, and activates it. Source it:
#
#     source scripts/setup.sh
#
# With ROS 2 Jazzy sourced, it makes .venv on top of that (system site packages), keeps the system's
# NumPy, and adds what is missing. Without, it installs the Jazzy wheels into .venv. Then it builds
# the packages with colcon, and compiles what Numba would otherwise compile at the first start
# of a node. What is done already is not done again. See docs/start/install.md.

_usage() {
    cat <<'USAGE'
usage: source scripts/setup.sh [--franka]

Makes .venv with what the packages need, builds the packages into install/, compiles what Numba
compiles, and activates all of it in this shell. What is done already is not done again.

  --franka  installs libfranka, too, and a simulated FR3: see docs/start/franka.md
  PYTHON    the Python to make .venv of (default: python3)
USAGE
}

_setup() {
    local root python venv stamp wanted inputs
    local -x PYTHONDONTWRITEBYTECODE= # compiled modules are kept, for all later starts
    root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
    python="${PYTHON:-python3}"
    venv="$root/.venv"

    if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
        echo "setup: Python 3.10 or newer is needed; '$python' is" \
            "$("$python" --version 2>&1 || true). Set PYTHON to another one." >&2
        return 1
    fi
    # With .venv active, the Python that it was made from.
    python="$("$python" -c 'import sys
print(sys._base_executable if sys.prefix == sys.argv[1] else sys.executable)' "$venv")"

    local ros=wheels reason
    if [ -n "${ROS_DISTRO:-}" ] && [ "$ROS_DISTRO" != jazzy ]; then
        echo "setup: ROS 2 '$ROS_DISTRO' is sourced, but this is for Jazzy;" \
            "open a shell without it." >&2
        return 1
    elif [ -n "${ROS_DISTRO:-}" ]; then
        if reason="$("$python" -c 'import rclpy' 2>&1)"; then
            ros=sourced
        elif [[ "$reason" != *"No module named 'rclpy'" ]]; then
            echo "setup: ROS 2 Jazzy is sourced, but not for '$python'" \
                "($("$python" --version 2>&1)): $(tail -n 1 <<<"$reason")." \
                "Set PYTHON to the one that ROS uses, such as /usr/bin/python3." >&2
            return 1
        fi
    fi

    # The inputs of an installation; when one of them changes, it is repeated.
    stamp="$venv/.installed"
    inputs="$(cat "$root"/requirements/{common,constraints,left_out,pinocchio,wheels}.txt; echo "$ros"
        "$python" --version; [ "$ros" = wheels ] || _packages fingerprint)"
    wanted="$(printf '%s' "$inputs" | sha256sum | cut -d' ' -f1)"
    if [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]; then
        _install || return 1
        printf '%s' "$wanted" >"$stamp"
    fi

    if [ "${1:-}" = --franka ] && [ ! "$venv/.franka" -nt "$root/requirements/franka.txt" ]; then
        echo "setup: installing libfranka and franky-sim" >&2
        _pip mujoco || return 1
        _pip --no-deps -r "$root/requirements/franka.txt" || return 1
        touch "$venv/.franka"
    fi

    # shellcheck disable=SC1091
    source "$venv/bin/activate"
    _build || return 1
    # shellcheck disable=SC1091
    source "$root/install/local_setup.bash"
    _compile
}

_packages() {
    "$python" "$root/scripts/packages.py" "$@"
}

_install() {
    local options=() output
    if [ -L "$venv" ]; then
        echo "setup: .venv is a link to '$(readlink "$venv")', which would be wiped; remove the" \
            "link" >&2
        return 1
    fi
    if [ "$ros" = sourced ]; then
        echo "setup: ROS 2 Jazzy is sourced; making .venv on top of its Python packages" >&2
        options+=(--system-site-packages)
    else
        [ -z "${ROS_DISTRO:-}" ] || echo "setup: '$python' has no rclpy" >&2
        echo "setup: no usable ROS 2; installing the Jazzy wheels into .venv" >&2
    fi
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        echo "setup: '$python' cannot make virtual environments;" \
            "on Ubuntu: sudo apt install python3-venv" >&2
        return 1
    fi
    echo "setup: this downloads up to 0.5 GB, fills up to 1.4 GB in .venv, and takes minutes" >&2
    if ! output="$("$python" -m venv --clear "${options[@]}" "$venv" 2>&1)"; then
        _explain "making .venv"
        return 1
    fi
    _packages plan "$ros" >&2 || return 1
    mkdir "$venv/wheels"
    # In a shell of its own, because an interactive one would report the job.
    (_fetch & _install_pybullet; status=$?; wait; exit "$status") || return 1
    # Without dependencies what would replace the system's NumPy, see requirements/pinocchio.txt.
    [ ! -s "$venv/no_deps.txt" ] || _pip --no-deps -r "$venv/no_deps.txt" || return 1
    _pip -r "$venv/requirements.txt" || return 1
    rm -rf "$venv/wheels"
    "$venv/bin/python" "$root/scripts/packages.py" leave_out
    "$venv/bin/python" "$root/scripts/packages.py" report >&2
}

# Downloads several packages at a time, which pip by itself does not; what fails fails again in _pip.
_fetch() {
    cat "$venv/no_deps.txt" "$venv/requirements.txt" | xargs -n 8 -P 4 \
        "$venv/bin/python" -m pip download --disable-pip-version-check --no-deps \
        --constraint "$venv/constraints.txt" --dest "$venv/wheels" >/dev/null 2>&1
}

# Python compiles what is imported, which is a small part.
_pip() {
    if ! output="$("$venv/bin/python" -m pip install --disable-pip-version-check --no-compile \
        --find-links "$venv/wheels" --constraint "$venv/constraints.txt" "$@" 2>&1)"; then
        _explain "installing packages"
        return 1
    fi
}

# Says why a command failed, by its output.
_explain() {
    local why free
    mkdir -p "$venv" 2>/dev/null
    free="$(df --output=avail "$venv" | tail -n 1)" # KB; ensurepip does not say that it has none
    if [ "$free" -lt 20000 ] ||
        [[ "${output,,}" =~ 'no space left'|'errno 28'|'disk quota exceeded' ]]; then
        why="no space is left. .venv needs 2.5 GB; free are $((free / 1000)) MB in $venv and"
        why+=" $(df -h --output=avail "${TMPDIR:-/tmp}" | tail -n 1) in ${TMPDIR:-/tmp}"
    elif [[ "$output" =~ 'connection broken'|'ConnectTimeout'|'ReadTimeout'|'Max retries' ]]; then
        why="the package index cannot be reached (network, proxy, or pip's configuration)"
    elif [[ "$output" =~ 'No matching distribution'|'ResolutionImpossible' ]]; then
        why="the package index has no versions that fit $("$python" --version) on $(uname -m)"
    elif [[ "$output" =~ 'Python.h: No such file'|"No such file or directory: '"[^\']*(cc|[gc]\+\+)\' ]]
    then
        why="there is no compiler, or Python.h is missing; sudo apt install g++ python3-dev"
    else
        why="see above"
    fi
    grep -E '^ *(error|ERROR|fatal)|: (fatal )?error[: ]|The user requested|^ .* depends on ' \
        <<<"$output" | tail -n 4 | cut -c 1-300 >&2
    echo "setup: $1 failed: $why" >&2
}

_install_pybullet() {
    if "$venv/bin/python" -c 'import pybullet' >/dev/null 2>&1; then
        return 0
    fi
    if "$python" -c 'import sys; sys.exit(sys.version_info >= (3, 12))'; then
        _pip pybullet
        return
    fi
    echo "setup: PyBullet has no wheel for this Python; building it takes 5 to 10 minutes, g++ and" \
        "python3-dev. On Ubuntu 'sudo apt install python3-pybullet' is faster." >&2
    _pip pybullet
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
    echo "setup: compiling what Numba compiles, half a minute" >&2
    if ! PYTHONPATH="$root/reproduction:${PYTHONPATH:-}" python "$root/scripts/compile.py"; then
        echo "setup: compiling ahead failed; the nodes compile when they start" >&2
        return 0
    fi
    printf '%s' "$now" >"$compiled"
}

# Scripts source it with their own arguments in place.
if [ -z "${BASH_SOURCE[1]:-}" ] && [[ ! "${1:-}" =~ ^(--franka)?$ ]]; then
    [[ "$1" =~ ^(-h|--help)$ ]]
    _status=$?
    [ $_status -eq 0 ] || echo "setup: unknown option '$1'" >&2
    _usage
    unset -f _usage _setup _packages _install _fetch _pip _explain _install_pybullet _build _compile
    return $_status 2>/dev/null || exit $_status
fi

# One at a time: two shells may source this at once.
exec {_lock}>"$(dirname "${BASH_SOURCE[0]}")/../.setup.lock"
flock "$_lock"
_setup "${1:-}"
_status=$?
exec {_lock}>&-
unset -f _usage _setup _packages _install _fetch _pip _explain _install_pybullet _build _compile
unset _lock
(exit $_status)
