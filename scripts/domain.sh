# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
# Sets ROS_DOMAIN_ID for a demo, so that other robots and demos do not interfere. Source it.
#
# Where it is set already, it is refused in one line if another demo of this user runs in that
# domain. Otherwise a domain is taken that no program on
# this machine uses.

_is_used() { # by any ROS node: the port of the first one
    grep -qF "$(printf ':%04X ' $((7410 + 250 * $1)))" /proc/net/udp
}
_keep() { # until this shell and the nodes that it starts have ended
    local directory="${XDG_RUNTIME_DIR:-/tmp}/viability_bounds_$UID" lock
    mkdir -p "$directory"
    exec {lock}>"$directory/domain_$1" && flock --nonblock "$lock"
}
_choose_domain() {
    local i
    if [ -n "${ROS_DOMAIN_ID:-}" ]; then
        _keep "$ROS_DOMAIN_ID" && return
        echo "error: another demo runs in ROS domain $ROS_DOMAIN_ID: stop it, or set" \
            "another ROS_DOMAIN_ID or none" >&2
        return 1
    fi
    for ((i = 0; i < 100; i++)); do
        export ROS_DOMAIN_ID=$((1 + ($$ + i) % 100))
        ! _is_used "$ROS_DOMAIN_ID" && _keep "$ROS_DOMAIN_ID" && return
    done
    echo "error: all ROS domains from 1 to 100 are in use: set ROS_DOMAIN_ID" >&2
    return 1
}
_choose_domain
