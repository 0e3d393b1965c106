#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Identifies the friction of a robot's joints from a recording of its motion or, without one, from a
# motion in simulation. Sets up what it needs.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/identify_friction.sh [robot] [-o FILE] [--recording FILE]

  robot         a parameter file in config/ (default: talos_left_arm)
  -o            parameter file to write (default: results/friction/<robot>.yaml)
  --recording   recorded motion of the robot (.npz: t, q, v, tau); by default one is made in
                simulation and kept next to the parameter file
USAGE
}
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/options.sh
source "$root/scripts/options.sh"
robot=talos_left_arm output='' recording=''
while [ $# -gt 0 ]; do
    case "$1" in
    -o | --output) output="$(value "$@")"; output="$(realpath -m -- "$output")"; shift ;;
    --recording) recording="$(value "$@")"; recording="$(realpath -m -- "$recording")"; shift ;;
    -h | --help) usage; exit 0 ;;
    -*) refuse "unknown option '$1'; --help lists them" ;;
    *) robot="$1" ;;
    esac
    shift
done
config="$root/config/$robot.yaml"
if [ ! -f "$config" ]; then
    known="$(cd "$root/config" && ls -- *.yaml | sed 's/\.yaml//' | tr '\n' ' ')"
    refuse "unknown robot '$robot'; there are: $known"
fi
if [ -z "$output" ]; then
    output="$root/results/friction/$robot.yaml"
    mkdir -p "$root/results/friction"
fi

set +u # ROS' own set-up scripts use unset variables
# shellcheck disable=SC1091
source "$root/scripts/setup.sh"
set -u

if [ -z "$recording" ]; then
    recording="${output%.yaml}.npz"
    "$root/install/sim_bridge/lib/sim_bridge/record_excitation" "$config" -o "$recording"
fi
exec "$root/install/torque_safety_controller/lib/torque_safety_controller/identify_friction" \
    "$config" "$recording" -o "$output"
