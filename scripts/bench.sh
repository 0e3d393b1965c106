#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Measures run times and prints them. Ratios compare programs that run in turns in one process.
#
#     bash scripts/bench.sh chain     from state to command through both nodes, against empty relays
#     bash scripts/bench.sh step      one controller step, part by part
#     bash scripts/bench.sh bounds    acceleration bounds: one arm, and batches; with --tsid
#                                     also TSID's, which is installed into .venv-tsid
#     bash scripts/bench.sh robot     physics steps of the simulated robot, and their accuracy
#     bash scripts/bench.sh collision pairs of shapes, and controller steps with and without them
#     bash scripts/bench.sh antiwindup  limits on the integral torque, in closed form and by a solver
#     bash scripts/bench.sh compliance  controller steps with integral action, sensor and contacts
set -eu
root="$(cd "$(dirname "$0")/.." && pwd)"
name="${1:-}"
if [ -z "$name" ] || [ ! -f "$root/benchmarks/bench_$name.py" ]; then
    known="$(cd "$root/benchmarks" && ls bench_*.py | sed 's/bench_//; s/.py//' | tr '\n' ' ')"
    echo "usage: bash scripts/bench.sh NAME [options]; there are: $known" >&2
    exit 2
fi
shift
set +u
# shellcheck disable=SC1091
source "$root/scripts/setup.sh"
set -u
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-$((1 + $$ % 100))}"
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
exec python "$root/benchmarks/bench_$name.py" "$@"
