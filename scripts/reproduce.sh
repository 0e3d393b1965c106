#!/usr/bin/env bash
# Reproduces what a paper shows, into results/, and prints a table beside the paper's numbers.
#
#     bash scripts/reproduce.sh paper0             all its figures, and docs/reproduction.md
#     bash scripts/reproduce.sh paper0 fig5        one of them
#     bash scripts/reproduce.sh paper1-integral    the second paper: handover, anti-windup, endurance
#     bash scripts/reproduce.sh paper1-compliance  pushes, poles in the way, the hand led and pressing
#     bash scripts/reproduce.sh state_dependent    Baxter reaches faster, with limits by state
#     bash scripts/reproduce.sh friction           TALOS with friction compensation
#     bash scripts/reproduce.sh exactness          the bounds against brute force (half an hour)
#     bash scripts/reproduce.sh all                all but the last
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
