#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Drives robots at their limits in real time while programs are paused or the machine is busy, and
# checks the limits.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/overload.sh [--seconds N] [--robot NAME] [--way WAY] [--load LOAD]
                                [--imperfect] [--seed N] [--out DIRECTORY]

  --seconds    of each run (default: 60, about 45 min in all)
  --robot      panda, talos_left_arm, baxter_left_arm; repeatable (default: all)
  --way        "one process", "stack + robot" (safety_stack and bullet_node), "processes";
               repeatable (default: all)
  --load       idle; busy: a process on each processor that computes without end; "pause NAME":
               a program, or all, paused for 5 to 500 ms at random; repeatable (default: all)
  --imperfect  with config/imperfect/<robot>.yaml
  --seed       of goals and pauses (default: 0)
  --out        where report.md and metrics.json go (default: results/overload)

Exits with 0 when no limit of position, speed or torque was passed, 1 when one was, 2 when the report
cannot be written. Each run has a
ROS domain of its own.
USAGE
}
case "${1:-}" in -h | --help) usage; exit 0 ;; esac
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/environment.sh
source "$root/scripts/environment.sh"
exec python "$root/benchmarks/overload.py" "$@"
