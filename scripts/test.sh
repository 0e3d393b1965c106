#!/usr/bin/env bash
# Runs the tests, setting itself up first. Arguments go to pytest:
#
#     bash scripts/test.sh                  all of them
#     bash scripts/test.sh -k viability     some of them
set -eu
root="$(cd "$(dirname "$0")/.." && pwd)"
set +u
# shellcheck disable=SC1091
source "$root/scripts/setup.sh"
set -u
cd "$root"
# A ROS domain of its own, so that other nodes do not interfere.
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-$((1 + $$ % 100))}"
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
exec python -m pytest "$@"
