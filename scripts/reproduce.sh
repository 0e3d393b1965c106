#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Reproduces the figures of a paper, writes them to results/, and prints a table with the paper's
# numbers and ours.
#
#     bash scripts/reproduce.sh paper0             all its figures, and docs/reproduction.md
#     bash scripts/reproduce.sh paper0 fig5        one of them
#     bash scripts/reproduce.sh paper1-integral    the second paper: handover, anti-windup, endurance
#     bash scripts/reproduce.sh paper1-compliance  pushes, poles, yielding and pressing hand
#     bash scripts/reproduce.sh state_dependent    Baxter with state-dependent acceleration limits
#     bash scripts/reproduce.sh friction           TALOS with friction compensation
#     bash scripts/reproduce.sh exactness          the bounds compared with brute force (30 min)
#     bash scripts/reproduce.sh all                all of the above except exactness
set -eu
root="$(cd "$(dirname "$0")/.." && pwd)"
what="${1:-all}"
[ $# -eq 0 ] || shift
if [ "$what" = all ]; then
    for part in paper0 paper1-integral paper1-compliance state_dependent friction; do
        bash "$root/scripts/reproduce.sh" "$part"
    done
    exit 0
fi
what="${what//-/_}"
case "$what" in
paper0 | paper1_integral | paper1_compliance | state_dependent | friction | exactness) ;;
*)
    parts="all|paper0|paper1-integral|paper1-compliance|state_dependent|friction|exactness"
    echo "usage: bash scripts/reproduce.sh $parts [part or options]" >&2
    exit 2
    ;;
esac
set +u
# shellcheck disable=SC1091
source "$root/scripts/setup.sh"
set -u
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-$((1 + $$ % 100))}"
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
exec python "$root/reproduction/$what.py" "$@"
