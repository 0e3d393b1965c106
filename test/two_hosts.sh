#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The robot on one host, its control on another, with a bad network between them, as docs/hosts.md
# describes. The hosts are two network namespaces that a veth pair joins. Checks that the limits are
# kept, and that the arm goes on after the link was cut.
set -euo pipefail
usage() {
    cat <<'USAGE'
usage: bash test/two_hosts.sh [--seconds N] [--seed N] [--params FILE] [--out FILE]

  --seconds  of motion before the link is cut (default: 20)
  --seed     of goals and faults (default: 0)
  --params   a further parameter file, given last
  --out      JSON file for the numbers measured

Exits with 0 when all went well, or with one line why it is skipped; with 1 when something was not
as it should be. All namespaces and processes end with it, however it ends.
USAGE
}
case "${1:-}" in -h | --help) usage; exit 0 ;; esac
root="$(cd "$(dirname "$0")/.." && pwd)"

# Namespaces of processes, mounts and, where this is not root, users: nothing outside is changed, and
# the system ends and removes all of it together with the first process.
own=(unshare --net --mount --pid --fork --kill-child --mount-proc)
[ "$(id -u)" -eq 0 ] || own+=(--user --map-root-user)
hosts() {
    mount -t tmpfs none /run
    ip netns add robot
    ip netns add control
    ip link add robot0 netns robot type veth peer name control0 netns control
    ip -n robot addr add 10.77.0.1/24 dev robot0
    ip -n control addr add 10.77.0.2/24 dev control0
    local host
    for host in robot control; do
        ip -n "$host" link set lo up
        ip -n "$host" link set "${host}0" up
        # Discovery is by multicast, which needs a route; most hosts have a default one.
        ip -n "$host" route add default dev "${host}0"
        ip netns exec "$host" true
    done
}
if [ "${1:-}" != --inside ]; then
    if ! why="$(set +e; "${own[@]}" bash -c "set -e; $(declare -f hosts); hosts" 2>&1)"; then
        echo "two_hosts: skipped: no network namespaces here (${why//$'\n'/; })"
        exit 0
    fi
    set +u
    # shellcheck disable=SC1091
    source "$root/scripts/setup.sh"
    set -u
    exec "${own[@]}" bash "$0" --inside "$@"
fi
shift
hosts

# As docs/hosts.md says.
export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET ROS_DOMAIN_ID=7
# The hosts share this machine's memory, which real ones do not.
export FASTDDS_BUILTIN_TRANSPORTS=UDPv4
seed=0 more=()
parameters=(--params-file "$root/config/panda.yaml" --params-file "$root/config/two_hosts/panda.yaml")
while [ $# -gt 1 ]; do
    case "$1" in
    --params) parameters+=(--params-file "$2") ;;
    --seed) seed="$2" && more+=("$1" "$2") ;;
    *) more+=("$1" "$2") ;;
    esac
    shift 2
done
pids=()
start() { # host package program arguments
    ip netns exec "$1" "$root/install/$2/lib/$2/$3" --ros-args --log-level warn "${@:4}" &
    pids+=($!)
}
stop() {
    trap - EXIT
    kill "${pids[@]}" 2>/dev/null || true
    wait "${pids[@]}" 2>/dev/null || true
}
trap stop EXIT
trap 'exit 130' INT TERM HUP
start robot sim_bridge bullet_node "${parameters[@]}" \
    -r joint_states:=before_faults/joint_states
start control torque_safety_controller safety_stack "${parameters[@]}" \
    -r joint_commands:=before_faults/joint_commands
start control sim_bridge fault_node -p "faults:=$root/config/faults/two_hosts.yaml" \
    -p "fault_seed:=$seed"
ip netns exec control python "$root/test/two_hosts.py" --programs "${pids[*]}" "${more[@]}" "$@"
