#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Makes the parameter files of an arm from its URDF, and runs the arm. Sets up what it needs.
set -eu
usage() {
    cat <<'USAGE'
usage: bash scripts/new_robot.sh URDF TIP [NAME:=VALUE...] [--base LINK] [--name NAME] [--rate HZ]
                                 [--velocity-max RAD_S] [--tool KG,X,Y,Z] [--out DIRECTORY]
                                 [--ideal] [--force]
       bash scripts/new_robot.sh --topic TIP [options]
       bash scripts/new_robot.sh --table [ARM...]

  URDF        URDF file, xacro file, or package:// URI
  TIP         link at the end of the arm; of two arms both: LEFT,RIGHT
  NAME:=VALUE argument of a xacro file
  --topic     take the URDF from the topic robot_description
  --base      lock the joints before this link
  --name      of the files (default: that of the robot in the URDF)
  --rate      control rate in Hz (default: chosen)
  --velocity-max  largest speed limit of a joint, rad/s or m/s (default: that of the URDF)
  --tool      KG,X,Y,Z: mass and centre, m in the axes of the tip, of a tool that is not in the URDF
  --out       folder of the files (default: config)
  --ideal     only the exact robot, no imperfect one
  --force     replace files of this name
  --table     play arms of installed packages, in results/new_robot, and write the table in
              docs/start/your_robot.md; rows of arms that are not named stay

Writes <name>.yaml, scenarios/<name>_demo.yaml, and imperfect/<name>.yaml with an assumed robot
like real ones, a comment to each number. Plays the scenario in lockstep, into limits and back, with
the exact robot and with the imperfect one. docs/start/your_robot.md has more.
Exits with 0 when no limit was violated, 1 when one was or no files can be made, 2 when it could
not run.
USAGE
}
root="$(cd "$(dirname "$0")/.." && pwd)"
# shellcheck source=scripts/options.sh
source "$root/scripts/options.sh"
arguments=() out="$root/config" table=''
while [ $# -gt 0 ]; do
    case "$1" in
    -h | --help) usage; exit 0 ;;
    --table) table=yes ;;
    --out) out="$(value "$@")"; out="$(realpath -m "$out")"; shift ;;
    *) arguments+=("$1") ;;
    esac
    shift
done
set +u
# shellcheck disable=SC1091
source "$root/scripts/setup.sh"
set -u
[ -z "$table" ] || exec python "$root/reproduction/new_robots.py" "${arguments[@]}"

log="$(mktemp)"
trap 'rm -f "$log"' EXIT
"$root/install/torque_safety_controller/lib/torque_safety_controller/new_robot" \
    "${arguments[@]}" --out "$out" | tee "$log"
status="${PIPESTATUS[0]}"
[ "$status" -eq 0 ] || exit "$status"
config="$(sed -n 's/^written: \(.*\) (robot)$/\1/p' "$log")"
name="$(basename "$config" .yaml)"
[ -n "$config" ] || exit 0 # it said what it is for

results="$root/results/new_robot/$name"
worst=0
play() { # robot, results, options
    local status=0
    echo
    echo "the scenario with the $1 robot, in lockstep:"
    bash "$root/scripts/demo.sh" "$config" demo --out "${@:2}" || status=$?
    [ "$status" -le "$worst" ] || worst="$status"
}
play exact "$results"
! grep -q '^written: .* (imperfect)$' "$log" || play imperfect "$results/imperfect" --imperfect
echo
echo "figures and data: $results; again: bash scripts/demo.sh ${config/#"$root/config/$name.yaml"/$name}"
exit "$worst"
