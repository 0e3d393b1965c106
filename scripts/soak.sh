#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Drives a simulated robot for as long as is wanted, with everything that can go wrong, and reports.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/soak.sh [--minutes N] [--robot NAME] [--seed N] [--processes] [--every N]
                            [--rate HZ] [--out DIRECTORY]

  --minutes    how long (default: 60); Ctrl-C ends it earlier, with its report
  --robot      panda (default), talos_left_arm, baxter_left_arm
  --seed       of goals, pushes and faults (default: 0)
  --processes  each node in a process of its own, which are killed, too; without, robot and control
               are one process, as in scripts/demo.sh
  --every      seconds from one fault to the next (default: 8)
  --rate       control rate in Hz (default: the robot's own)
  --out        where report.md and metrics.json go (default: results/soak)

In real time: goals for joints and hand at random, pushes, faults between the nodes and of the
processes. Exits with 0 when all limits were kept, every fault was followed by motion again, no
program ended and memory did not grow; 1 when not; 2 when it could not run. See docs/soak.md.
USAGE
}
case "${1:-}" in -h | --help) usage; exit 0 ;; esac
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/environment.sh
source "$root/scripts/environment.sh"
export PYTHONPATH="$root/reproduction:${PYTHONPATH:-}"
exec python "$root/reproduction/bad_days/soak.py" "$@"
