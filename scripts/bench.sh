#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Measures run times and prints them.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/bench.sh NAME [options]

Ratios compare programs that run in turns in one process. NAME --help lists options.

  chain       from state to command through both nodes, against empty relays; with --imperfect
              also with estimator, prediction and margins
  realtime    all nodes by the wall clock: one process, separate ones, relays, and what the
              machine itself can do; with --loads limits kept while the machine is busy or programs
              stop (20 min)
  peers       limits kept beside TSID, placo and a clamp
  franka      one period of a Franka arm's nodes, which a simulated FR3 answers
  step        one controller step; with --stages by stage, beside TSID's
  bounds      acceleration bounds: one arm, and batches

TSID and placo are installed into .venv-tsid and .venv-placo.
USAGE
}
root="$(cd "$(dirname "$0")/.." && pwd)"
name="${1:-}"
case "$name" in -h | --help) usage; exit 0 ;; esac
if [ -z "$name" ] || [ ! -f "$root/benchmarks/bench_$name.py" ]; then
    known="$(cd "$root/benchmarks" && ls bench_*.py | sed 's/bench_//; s/.py//' | tr '\n' ' ')"
    echo "error: no benchmark '$name'; there are: $known" >&2
    exit 2
fi
shift
# shellcheck source=scripts/environment.sh
source "$root/scripts/environment.sh"
export PYTHONPATH="$root/reproduction:${PYTHONPATH:-}"
exec python "$root/benchmarks/bench_$name.py" "$@"
