# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
# What other scripts begin with: the environment that setup.sh makes, and a ROS domain of their own
# that ends at this host, so that other nodes do not interfere. Source it.
set +u # ROS' own set-up scripts use unset variables
# shellcheck source=scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
set -u
# Matrices here are small: more threads only wait for each other.
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-$((1 + $$ % 100))}"
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
