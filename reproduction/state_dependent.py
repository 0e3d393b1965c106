# SPDX-License-Identifier: Apache-2.0
"""How much faster Baxter's arm reaches with acceleration limits that depend on its state.

bash scripts/reproduce.sh state_dependent

Three reaches through the real nodes in lockstep, with the posture task stiff enough for the limits
to decide: to two postures, one of them near limits, and back.
"""

from __future__ import annotations

import numpy as np
from chain import ChainResult, load_values, run_chain
from figure import Figure, joint_axes, table

from viability_bounds_pkg.estimation.discretisation_margin import discretisation_margin
from viability_bounds_pkg.node.bounds_parameters import PEAK
from viability_bounds_pkg.robot_description import build_model, read_urdf

ROBOT = "baxter_left_arm"
# s0, s1, e0, e1, w0, w1, w2, rad. The motors can hold the arm in all of them.
ACROSS = [-1.65, -0.1, -1.0, 2.2, 1.5, 1.0, -1.5]
FOLDED = [1.65, -1.2, 1.0, 2.55, -1.5, -1.5, 1.5]
PAUSE = 4.0  # s between goals
NEAR = 0.01  # rad
STIFF = {
    "posture_kp": 400.0,
    "posture_weight": 1.0,
    "pose_weight": 0.0,
    "safety_filter": False,  # the limits alone
}


def play(values: dict, goals: list[list[float]], limits: str) -> ChainResult:
    """Reach for the goals, one after the other."""
    events = [
        {"time": k * PAUSE, "posture": dict(zip(values["joints"], goal, strict=True))}
        for k, goal in enumerate(goals)
    ]
    scenario = {"duration": len(goals) * PAUSE, "events": events}
    own = {"acceleration_limits": limits, "acceleration_drift": drift(values, limits)}
    return run_chain(values | STIFF, scenario, {"bounds_node": own})


def drift(values: dict, limits: str) -> list[float]:
    """Return how fast the acceleration changes under a held torque, and 5%, rad/s^3."""
    a_min, a_max = (np.array(values[f"acceleration_{end}"]) for end in ("min", "max"))
    if limits == "state_dependent":
        a_max = PEAK * np.maximum(-a_min, a_max)
        a_min = -a_max
    found = discretisation_margin(
        build_model(read_urdf(values["robot_description"]), values["joints"]),
        values["position_min"],
        values["position_max"],
        values["velocity_max"],
        a_min,
        a_max,
        values["torque_max"],
        1.0 / values["rate_hz"],
    )
    return (1.05 * found.jerk).tolist()


def main() -> int:
    """Play, print, and tell whether it was faster without breaking a limit."""
    values = load_values(ROBOT)
    goals = [ACROSS, FOLDED, values["start_positions"]]
    names = ("to the side", "folded", "back to the start")
    figure = Figure("state_dependent")
    joints = values["joints"]
    picture, axes = joint_axes(joints, "time [s]", "position [rad]")
    times, fine = {}, True
    for limits in ("worst_case", "state_dependent"):
        result = play(values, goals, limits)
        run = result.run
        figure.data[limits] = np.column_stack([run.t, run.q, run.v, run.tau])
        broken = [
            float(result.vector(key).max())
            for key in ("position_violation_rad", "velocity_violation_rad_s")
        ]
        ratio = float(result.vector("torque_ratio").max())
        fine &= broken == [0.0, 0.0] and ratio <= 1.0
        figure.metrics |= {
            f"{limits}_position_violation_rad": broken[0],
            f"{limits}_velocity_violation_rad_s": broken[1],
            f"{limits}_torque_ratio": ratio,
        }
        times[limits] = []
        for k, goal in enumerate(goals):
            during = (run.t >= k * PAUSE) & (run.t < (k + 1) * PAUSE)
            far = np.abs(run.q[during] - goal).max(axis=1) > NEAR
            last = np.flatnonzero(far)[-1]
            arrived = float(run.t[during][last] - k * PAUSE)
            times[limits].append(arrived if last < far.size - 1 else float("inf"))
            figure.metrics[f"{limits}_{names[k].replace(' ', '_')}_s"] = times[limits][-1]
        for j, axis in enumerate(axes):
            axis.plot(run.t, run.q[:, j], label=limits.replace("_", " "))
    for j, axis in enumerate(axes):
        for k, goal in enumerate(goals):
            axis.plot([k * PAUSE, (k + 1) * PAUSE], [goal[j]] * 2, "k:", linewidth=1.0)
    axes[0].legend()
    for name, usual, ours in zip(
        names, times["worst_case"], times["state_dependent"], strict=True
    ):
        faster = ours < usual
        fine &= faster
        shown = [f"{t:.2f} s" if t < PAUSE else f"not within {PAUSE:g} s" for t in (usual, ours)]
        figure.rows.append((f"Baxter, {name}", *shown, "faster" if faster else "DIFFERS"))
    figure.save(picture)
    print(
        table(
            [figure],
            ("reach, until all joints are within 10 mrad", "worst case", "state dependent", ""),
        )
    )
    print(
        f"limits broken: {'none' if fine else 'SEE results/state_dependent/metrics.json'}; "
        f"torque at most {figure.metrics['state_dependent_torque_ratio']:.3f} of its limits"
    )
    return int(not fine)


if __name__ == "__main__":
    raise SystemExit(main())
