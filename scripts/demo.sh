#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Simulates an arm that is driven to its limits, and checks the limits. Sets up what it needs.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/demo.sh [robot] [scenario] [--bounds METHOD] [--rate HZ] [--real-time]
                            [--imperfect] [--params FILE]... [--out DIRECTORY] [--processes]
                            [--view] [--record]

  robot        the name of a parameter file in config/, as baxter_left_arm (default), panda and
               talos_left_arm, or the path of one; scripts/new_robot.sh makes one from a URDF; fr3
               also installs libfranka, see docs/start/franka.md
  scenario     the name in config/scenarios/<robot>_<scenario>.yaml, beside the robot's file, or the
               path of a file, see docs/guides/simulation.md (default: demo; of a robot that has none, it
               holds its start posture for 2 s)
  --bounds     how acceleration limits are computed: exact (default), or naive, which violates the
               limits, decre, rubrecht; these without the safety filter
  --rate       control rate in Hz (default: the robot's own)
  --real-time  by the wall clock; without, in lockstep: the simulation waits for each command, so
               that it is as fast as the machine can, repeatable, and misses no deadline
  --imperfect  with encoders, delays, motors and lost commands like those of a real robot, and
               with what is done about them, from config/imperfect/<robot>.yaml; estimator_node
               runs, too; see docs/guides/simulation.md
  --params     a further parameter file, such as config/obstacles/panda_wall.yaml; repeatable, the
               last value given counts
  --processes  each node in a process of its own; without, robot, estimator, bounds and controller
               are one process (docs/guides/real_time.md)
  --view       shows the arm on a page in the browser, by the wall clock; Enter plays the scenario,
               in between the arm can be driven there, Ctrl-C ends (docs/guides/tools.md); where standard
               input is no terminal, the scenario is played once
  --record     also writes all messages to recording.mcap there, for Foxglove and PlotJuggler
               (docs/guides/tools.md)
  --out        where figure, data and metrics go (default: results/<robot>_<scenario>; then
               results/demo is a link to it)

Exits with 0 when no limit was violated, 1 when one was, 2 when it could not run.
USAGE
}
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/options.sh
source "$root/scripts/options.sh"
robot='' scenario='' bounds=exact rate=default params=() imperfect='' clock=lockstep out='' processes='' view='' record=''
while [ $# -gt 0 ]; do
    case "$1" in
    --bounds) bounds="$(value "$@")"; shift ;;
    --rate) rate="$(value "$@")"; shift ;;
    --params) params+=("$(value "$@")"); shift ;;
    --out) out="$(value "$@")"; shift ;;
    --imperfect) imperfect=yes ;;
    --processes) processes=yes ;;
    --lockstep) clock=lockstep ;;
    --real-time) clock=real_time ;;
    --record) record=yes ;;
    --view) view=yes clock=real_time ;;
    -h | --help) usage; exit 0 ;;
    -*) refuse "unknown option '$1'; --help lists them" ;;
    *)
        if [ -z "$robot" ]; then robot="$1"
        elif [ -z "$scenario" ]; then scenario="$1"
        else refuse "unknown argument '$1'; see --help"
        fi
        ;;
    esac
    shift
done
robot="${robot:-baxter_left_arm}" scenario="${scenario:-demo}"
config="$root/config/$robot.yaml"
if [[ "$robot" == *.yaml && -f "$robot" ]]; then
    config="$(realpath "$robot")"
    robot="$(basename "$robot" .yaml)"
elif [ ! -f "$config" ]; then
    known="$(cd "$root/config" && ls -- *.yaml | sed 's/.yaml$//' | tr '\n' ' ')"
    refuse "unknown robot '$robot'; there are: $known; scripts/new_robot.sh makes others"
fi
folder="$(dirname "$config")"
scenarios="$folder/scenarios"
if [ -f "$scenarios/${robot}_$scenario.yaml" ]; then
    scenario="$scenarios/${robot}_$scenario.yaml"
elif [ ! -f "$scenario" ] && [ "$scenario" = demo ]; then
    scenario=hold
elif [ ! -f "$scenario" ]; then
    known="$(cd "$scenarios" 2>/dev/null && ls -- "${robot}"_*.yaml 2>/dev/null || true)"
    known="$(sed "s/^${robot}_//; s/.yaml$//" <<<"$known" | tr '\n' ' ')"
    refuse "unknown scenario '$scenario' of $robot; there are: $known"
fi

# What its nodes need from their start on.
own="$(dirname "$scenario")/start/$(basename "$scenario")"
[ ! -f "$own" ] || params=("$own" "${params[@]}")

[ -z "$imperfect" ] || imperfect="$folder/imperfect/$robot.yaml"
[ -z "$imperfect" ] || [ -f "$imperfect" ] || refuse "there is no $imperfect"
for each in "${params[@]}"; do
    [ -f "$each" ] || refuse "no parameter file '$each'"
done
case "$bounds" in
exact | naive | decre | rubrecht) ;;
*) refuse "--bounds is '$bounds'; allowed: exact, naive, decre, rubrecht" ;;
esac
if [ "$rate" != default ] && ! { [[ "$rate" =~ ^[0-9]*\.?[0-9]+$|^[0-9]+\.$ ]] &&
    awk -v rate="$rate" 'BEGIN { exit !(0 < rate && rate <= 10000) }'; }; then
    refuse "--rate is '$rate'; allowed: a number of Hz above 0, at most 10000"
fi
held=''
[ "$scenario" != hold ] || held=yes
link=''
if [ -z "$out" ]; then
    name="$(basename "$scenario" .yaml)"
    out="$root/results/${robot}_${name#"${robot}_"}${imperfect:+_imperfect}"
    link="$root/results/demo"
fi

set +u # ROS' own set-up scripts use unset variables
# An arm that its maker's protocol connects is simulated by a program of its own.
simulated="$(sed -n 's/^ *robot_node: *\(simulated_\w*\).*/\1/p' "$config")"
# shellcheck disable=SC1091
source "$root/scripts/setup.sh" ${simulated:+--franka}
set -u

# shellcheck disable=SC1091
source "$root/scripts/domain.sh" || exit 2
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST

if [ -n "$held" ]; then
    echo "no scenarios/${robot}_demo.yaml: the arm holds its start posture for 2 s" >&2
    scenario="$(mktemp --suffix=.yaml)"
    echo '{duration: 2.0, events: []}' >"$scenario"
fi

overrides=()
[ -z "$imperfect" ] || overrides+=(--params-file "$imperfect")
for each in "${params[@]}"; do
    overrides+=(--params-file "$each")
done
overrides+=(-p "clock:=$clock" -p "bounds_node:method:=$bounds" -p start_paused:=true)
# What other bounds do is to be seen, not what the filter makes of it.
if [ "$bounds" != exact ]; then
    unlimited="[$(sed -n 's/^ *joints: *\[\(.*\)\]/\1/p' "$config" | sed 's/[^,]*/.inf/g')]"
    overrides+=(-p "controller_node:safety_filter:=false")
    overrides+=(-p "controller_node:torque_rate_max:=$unlimited")
fi
[ "$rate" = default ] || overrides+=(-p "rate_hz:=$rate")
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
    trap - EXIT INT TERM HUP
    local running
    mapfile -t running < <(jobs -p)
    kill "${running[@]}" 2>/dev/null || true
    # The page has only the time that others leave: on a busy machine it would end minutes later.
    for _ in {1..50}; do
        kill -0 "${running[@]}" 2>/dev/null || break
        sleep 0.1
    done
    kill -KILL "${running[@]}" 2>/dev/null || true
    wait 2>/dev/null || true
    [ -z "$held" ] || rm -f "$scenario"
}
trap stop EXIT
trap 'exit 130' INT TERM HUP

package=sim_bridge driver=bullet_node stack=simulated_stack
if [ -n "$simulated" ]; then
    package=franka_bridge driver=franka_node stack=franka_stack
    overrides+=(-p robot_ip:=127.0.0.1 -p real_time:=false)
    start "$package" "$simulated"
    until (exec 3<>/dev/tcp/127.0.0.1/1337) 2>/dev/null; do
        kill -0 "${pids[0]}" 2>/dev/null || exit 2
        sleep 0.1
    done
fi
if [ -n "$processes" ]; then
    start viability_bounds_pkg bounds_node
    start torque_safety_controller controller_node
    [ -z "$imperfect" ] || start viability_bounds_pkg estimator_node
    start "$package" "$driver"
else
    start "$package" "$stack"
fi
[ -z "$view" ] || start sim_bridge viewer_node

# Sets `status` to that of the scenario, 2 when a node has ended, which could not start.
play() {
    "$root/install/sim_bridge/lib/sim_bridge/scenario_node" --out "$out" \
        ${record:+--record "$out/recording.mcap"} --ros-args \
        --log-level warn --params-file "$config" "${overrides[@]}" -p "scenario:=$scenario" &
    local ended play=$!
    status=0
    wait -n -p ended "$play" "${pids[@]}" || status=$?
    [ "$ended" = "$play" ] || exit 2
    if [ -n "$link" ] && [ "$status" -le 1 ]; then
        # Before there was a folder for each scenario, this was one.
        [ -L "$link" ] || [ ! -e "$link" ] || mv --backup=numbered -T "$link" "$link.old"
        ln -sfnT "$(basename "$out")" "$link"
    fi
}
if [ -n "$view" ] && [ -t 0 ]; then
    trap 'exit "${status:-0}"' INT
    echo "Enter plays the scenario, Ctrl-C ends"
    while read -r; do
        play
        echo "Enter plays the scenario, Ctrl-C ends; \"drive the arm\" on the page moves it"
    done
else
    play
fi
exit "$status"
