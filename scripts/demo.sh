#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Simulates an arm that is driven to its limits, and checks the limits. Sets up what it needs.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/demo.sh [robot] [scenario] [--bounds exact|naive] [--rate HZ] [--lockstep]
                            [--params FILE] [--out DIRECTORY]

  robot        a parameter file in config/ that has a scenario: baxter_left_arm (default), panda,
               talos_left_arm
  scenario     the name in config/scenarios/<robot>_<scenario>.yaml, or the path of a file,
               see docs/scenarios.md (default: demo)
  --bounds     how acceleration limits are computed; naive violates the limits (default: exact)
  --rate       control rate in Hz (default: the robot's own)
  --lockstep   the simulation waits for each command: as fast as the machine can, and repeatable
  --params     a second parameter file, such as config/obstacles/panda_wall.yaml
  --out        where figure, data and metrics go (default: results/demo)

Exits with 0 when no limit was violated, 1 when one was, 2 when it could not run.
USAGE
}

root="$(cd "$(dirname "$0")/.." && pwd)"
robot='' scenario='' bounds=exact rate='' params='' clock=real_time out="$root/results/demo"
while [ $# -gt 0 ]; do
    case "$1" in
    --bounds) bounds="${2:?--bounds needs a value}"; shift ;;
    --rate) rate="${2:?--rate needs a value}"; shift ;;
    --params) params="${2:?--params needs a value}"; shift ;;
    --out) out="${2:?--out needs a value}"; shift ;;
    --lockstep) clock=lockstep ;;
    -h | --help) usage; exit 0 ;;
    -*) echo "error: unknown option '$1'" >&2; usage >&2; exit 2 ;;
    *)
        if [ -z "$robot" ]; then robot="$1"
        elif [ -z "$scenario" ]; then scenario="$1"
        else echo "error: unknown argument '$1'" >&2; usage >&2; exit 2
        fi
        ;;
    esac
    shift
done
robot="${robot:-baxter_left_arm}" scenario="${scenario:-demo}"
scenarios="$root/config/scenarios"
config="$root/config/$robot.yaml"
if [ ! -f "$config" ] || [ ! -f "$scenarios/${robot}_demo.yaml" ]; then
    known="$(cd "$scenarios" && ls -- *_demo.yaml | sed 's/_demo.yaml//' | tr '\n' ' ')"
    echo "error: unknown robot '$robot'; there are: $known" >&2
    exit 2
fi
if [ -f "$scenarios/${robot}_$scenario.yaml" ]; then
    scenario="$scenarios/${robot}_$scenario.yaml"
elif [ ! -f "$scenario" ]; then
    known="$(cd "$scenarios" && ls -- "${robot}"_*.yaml)"
    known="$(sed "s/^${robot}_//; s/.yaml$//" <<<"$known" | tr '\n' ' ')"
    echo "error: unknown scenario '$scenario' of $robot; there are: $known" >&2
    exit 2
fi

if [ -n "$params" ] && [ ! -f "$params" ]; then
    echo "error: no parameter file '$params'" >&2
    exit 2
fi

set +u # ROS' own set-up scripts use unset variables
# shellcheck disable=SC1091
source "$root/scripts/setup.sh"
set -u

# shellcheck disable=SC1091
source "$root/scripts/domain.sh" || exit 2
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST

overrides=()
[ -z "$params" ] || overrides+=(--params-file "$params")
overrides+=(-p "clock:=$clock" -p "bounds_node:method:=$bounds" -p start_paused:=true)
[ -z "$rate" ] || overrides+=(-p "rate_hz:=$rate")
if [ "$clock" = lockstep ]; then
    # The robot waits for the nodes, so long time-outs are safe and a busy machine causes none.
    overrides+=(-p bounds_timeout:=5.0 -p state_timeout:=10.0)
fi

pids=()
start() {
    "$root/install/$1/lib/$1/$2" --ros-args --log-level warn \
        --params-file "$config" "${overrides[@]}" "${@:3}" &
    pids+=($!)
}
stop() {
    trap - EXIT INT TERM
    kill "${pids[@]}" 2>/dev/null || true
    wait "${pids[@]}" 2>/dev/null || true
}
trap stop EXIT
trap 'exit 130' INT TERM

start viability_bounds_pkg bounds_node
start torque_safety_controller controller_node
start sim_bridge bullet_node
"$root/install/sim_bridge/lib/sim_bridge/scenario_node" --out "$out" --ros-args \
    --log-level warn --params-file "$config" "${overrides[@]}" -p "scenario:=$scenario" &
play=$!

# The scenario ends by itself; a node that ends before it could not start.
status=0
wait -n -p ended "$play" "${pids[@]}" || status=$?
if [ "$ended" != "$play" ]; then
    kill "$play" 2>/dev/null || true
    wait "$play" 2>/dev/null || true
    exit 2
fi
exit "$status"
