#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Makes keys and signed permissions for DDS security of config/security/policy.xml.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/security.sh KEYSTORE

Makes a folder with keys and signed permissions for each program of this project, for the domain
ROS_DOMAIN_ID, by `ros2 security` of the ROS that is sourced, and says how to use it. Where the folder
exists, it is brought up to date. See docs/security.md.
USAGE
}
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/options.sh
source "$root/scripts/options.sh"
case "${1:-}" in
-h | --help) usage; exit 0 ;;
'' | -*) refuse "name the folder to make; see --help" ;;
esac
[ $# -eq 1 ] || refuse "one folder, not $#; see --help"
ros2 security --help >/dev/null 2>&1 ||
    refuse "there is no 'ros2 security': source ROS 2 with ros-jazzy-sros2, see docs/security.md"
umask 077 # the keys are for this user only
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-0}"
ros2 security generate_artifacts -k "$1" -p "$root/config/security/policy.xml"
cat <<USE
export ROS_DOMAIN_ID=$ROS_DOMAIN_ID ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce
export ROS_SECURITY_KEYSTORE=$(realpath "$1")
USE
