#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Reproduces the figures of a paper, and compares its numbers with ours.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/reproduce.sh [WHAT] [part or options]

Writes figures to results/ and tables to docs/results.md, and prints the tables.

  paper0             all figures of the first paper
  paper0 fig5        one of them
  paper1-integral    the second paper: handover, anti-windup, endurance
  paper1-compliance  pushes, poles, yielding and pressing hand
  whole_arm          weak motors, with and without the safety filter (10 min)
  imperfect          late, coarse and noisy robots, with and without each remedy (40 min on
                     two cores)
  imperfect panda    one of the robots
  contrast           the moving picture of README
  theory             figures and tables of the pages under docs/theory (4 min)
  fr3                a simulated FR3 at and beyond its limits, behind libfranka's protocol (45 min)
  fr3 --rows lockstep    one row of its table
  soak               faults while the arm moves: restarts, wrong states, second nodes (3 min)
  all                the first four (default)
USAGE
}

root="$(cd "$(dirname "$0")/.." && pwd)"
what="${1:-all}"
[ $# -eq 0 ] || shift
case "$what" in -h | --help) usage; exit 0 ;; esac
if [ "$what" = all ]; then
    for part in paper0 paper1-integral paper1-compliance whole_arm; do
        bash "$root/scripts/reproduce.sh" "$part"
    done
    exit 0
fi
what="${what//-/_}"
case "$what" in
paper0 | paper1_integral | paper1_compliance | whole_arm | imperfect | fr3 | contrast | theory | soak) ;;
*)
    echo "error: unknown '$what'; --help lists what there is" >&2
    exit 2
    ;;
esac
# shellcheck source=scripts/environment.sh
source "$root/scripts/environment.sh"
for room in "$root/reproduction" "$root"/reproduction/*/; do
    PYTHONPATH="$room:${PYTHONPATH:-}"
done
export PYTHONPATH
exec python "$root"/reproduction/*/"$what.py" "$@"
