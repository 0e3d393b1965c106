#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Sends odd messages to the real nodes, starts programs with odd files, and checks the claims.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/fuzz.sh [--messages N] [--files N] [--seed N] [--out DIRECTORY] | --replay FILE

  --messages   odd messages to the nodes, with parameters that change, nodes that go and come, time
               that leaps, rivals; 200000 take about 20 min
  --files      odd parameter files, scenarios and files of faults; 2000 take about 5 min
  --seed       of the first part (default: 1); each part has the next number
  --out        where cases that broke go (default: results/fuzz)
  --replay     plays a case again that broke

Exits with 0 when nothing broke, 1 when something did; then it says how to play it again. See
docs/fuzzing.md.
USAGE
}
case "${1:-}" in -h | --help) usage; exit 0 ;; esac
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/environment.sh
source "$root/scripts/environment.sh"
exec python -W ignore "$root/test/fuzz.py" "$@"
