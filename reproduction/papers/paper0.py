# SPDX-License-Identifier: Apache-2.0
"""Figures 1, 3, 4 and 5 and the timing of Algorithm 4 of [DelPrete2018], and a table beside it.

bash scripts/reproduce.sh paper0         all of it, and a table of docs/results.md
bash scripts/reproduce.sh paper0 fig5    one figure
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import yaml
from chain import ROOT, ChainResult, load_values, run_chain
from figure import Figure, joint_axes, reproduce, table, write_part
from matplotlib.colors import BoundaryNorm, ListedColormap

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.acceleration_limits import estimate_acceleration_limits
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model, read_urdf

sys.path.insert(0, f"{Path(__file__).resolve().parents[2]}/src/viability_bounds_pkg/test/support")

import paper_algorithms


def one_joint(q: float, v: float, a: float) -> JointLimits:
    """Return symmetric limits of one joint."""
    return JointLimits(("joint",), [-q], [q], [v], [-a], [a])


def figure_1() -> Figure:
    """State-space plot of the viability constraints of this paper, [5] and [6]."""
    figure = Figure("paper0-fig1")
    limits, dt = one_joint(1.0, 5.0, 15.0), 0.1
    q = np.linspace(-1.0, 1.0, 2001)
    column = q[:, None]
    curves = {
        "viability, this paper": viability.viable_velocity_range(column, limits),
        "Decré et al. [6]": baselines.decre_velocity_range(column, limits, dt),
        "Rubrecht et al. [5]": baselines.rubrecht_velocity_range(column, limits, dt),
    }
    reach = np.sqrt(2.0 * 15.0 * (q + 1.0))
    picture, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    styles = ("tab:blue", "tab:orange", "tab:green")
    for (name, (low, high)), color in zip(curves.items(), styles, strict=True):
        width = 4.0 if color == styles[0] else 1.5
        axis.plot(q, high[:, 0], color=color, linewidth=width, label=name)
        axis.plot(q, low[:, 0], color=color, linewidth=width)
        figure.data[name] = np.column_stack([q, low[:, 0], high[:, 0]])
    for sign in (-1.0, 1.0):
        axis.axhline(sign * 5.0, color="tab:red", linestyle="--", label=None)
        axis.axvline(sign, color="tab:red", linestyle="--")
    axis.plot(q, np.minimum(reach, 9.0), "k:", label="reachable from rest at a limit")
    axis.plot(q, -np.minimum(reach[::-1], 9.0), "k:")
    axis.set(
        xlabel="q [rad]",
        ylabel="velocity [rad/s]",
        xlim=(-1.05, 1.05),
        ylim=(-6, 6),
        title="q limits ±1 rad, velocity 5 rad/s, acceleration 15 rad/s²; dt of [5], [6]: 0.1 s",
    )
    axis.legend(loc="lower left", fontsize="small")
    exact, rubrecht = (curves[name][1][:, 0] for name in list(curves)[::2])
    conservative = bool((rubrecht <= exact + 1e-12).all())
    figure.metrics = {
        "widest_gap_to_rubrecht_rad_s": float((exact - rubrecht).max()),
        "exact_velocity_at_centre_rad_s": float(exact[1000]),
    }
    figure.rows.append(
        (
            "Fig. 1: [5] against the exact kernel",
            "inside it, conservative",
            f"inside it everywhere: {conservative}; by up to "
            f"{figure.metrics['widest_gap_to_rubrecht_rad_s']:.2f} rad/s",
            "agrees" if conservative else "DIFFERS",
        )
    )
    figure.save(picture)
    return figure


def figure_3() -> Figure:
    """Regions of the state space by active acceleration bound."""
    figure = Figure("paper0-fig3")
    limits, dt = one_joint(0.5, 2.0, 10.0), 0.1
    q, v = np.meshgrid(np.linspace(-0.5, 0.5, 401), np.linspace(-2.0, 2.0, 401))
    states = q.reshape(-1, 1), v.reshape(-1, 1)
    bounds = viability.acceleration_bounds(*states, limits, dt)
    active = paper_algorithms.active_upper_bounds(*states, limits, dt)[:, 0]
    # The paper's numbers: 2 position, 3 velocity, 4 acceleration, 5 viability.
    region = np.array([2, 3, 5, 4])[active]
    low, high = viability.viable_velocity_range(states[0], limits)
    region[(states[1] > high).ravel() | (states[1] < low).ravel()] = 1
    # Not reachable from inside, time running backwards: too fast so near to the limit behind.
    fast_up = states[1] > np.sqrt(2.0 * 10.0 * (states[0] + 0.5))
    fast_down = states[1] < -np.sqrt(2.0 * 10.0 * (0.5 - states[0]))
    region[(fast_up | fast_down).ravel()] = 0
    region = region.reshape(q.shape)
    figure.data = {"q": q, "v": v, "region": region, "upper": bounds.upper.reshape(q.shape)}
    names = ("unreachable", "not viable", "position", "velocity", "acceleration", "viability")
    colors = ("#d9d9d9", "#4d4d4d", "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728")
    picture, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    mesh = axis.pcolormesh(
        q, v, region, cmap=ListedColormap(colors), norm=BoundaryNorm(np.arange(-0.5, 6), 6)
    )
    bar = picture.colorbar(mesh, ticks=range(6))
    bar.ax.set_yticklabels([f"{i}: {name}" for i, name in enumerate(names)])
    axis.set(xlabel="q [rad]", ylabel="velocity [rad/s]", title="dt = 0.1 s, as in the paper")
    share = {name: float((region == i).mean()) for i, name in enumerate(names)}
    figure.metrics = {f"share_{name}": value for name, value in share.items()}
    present = all(share[name] > 0.0 for name in names)
    shown = ", ".join(f"{name} {value:.1%}" for name, value in share.items())
    figure.rows.append(
        (
            "Fig. 3: regions by active upper bound",
            "six regions: unreachable, not viable, and four bounds",
            shown,
            "agrees: all six are present" if present else "DIFFERS: a region is missing",
        )
    )
    figure.save(picture)
    return figure


def joint_space_run(method: str, factor: float) -> ChainResult:
    """Play Fig. 4: Baxter's first joint, driven 0.1 rad beyond its upper limit."""
    values = load_values("baxter_left_arm") | {"safety_filter": False}
    n = len(values["joints"])
    first = [2.0] + values["position_max"][1:]
    values |= {
        "position_max": first,
        "velocity_max": [2.0] * n,
        "acceleration_min": [-12.0] * n,
        "acceleration_max": [12.0] * n,
        # The paper controls accelerations: torque must not be what limits them.
        "torque_max": [1e4] * n,
        "acceleration_drift": [],
        "position_margin": 0.0,
        # Small steps, so that what PyBullet adds to a position stays below 1e-7 rad.
        "physics_step_max": 1e-4,
        "method": method,
        "bounds_dt_factor": factor,
        "start_positions": [0.0, -0.5, 0.0, 1.0, 0.0, 0.5, 0.0],
        "pose_weight": 0.0,
        "posture_kp": 1000.0,
        "posture_weight": 1.0,
    }
    goal = dict(zip(values["joints"], values["start_positions"], strict=True))
    goal[values["joints"][0]] = 2.1
    scenario = {"duration": 2.5, "events": [{"time": 0.0, "posture": goal}]}
    # Only here may a goal lie outside the limits.
    beyond = {"controller_node": {"position_max": [2.2] + values["position_max"][1:]}}
    return run_chain(values, scenario, beyond)


def figure_4() -> Figure:
    """Trajectories of the first joint under four ways to bound accelerations."""
    figure = Figure("paper0-fig4")
    cases = {
        "a: naive, dt": ("naive", 1.0),
        "b: naive, 2 dt": ("naive", 2.0),
        "b: naive, 5 dt": ("naive", 5.0),
        "c: exact, dt": ("exact", 1.0),
        "d: exact, 2 dt": ("exact", 2.0),
        "d: exact, 5 dt": ("exact", 5.0),
    }
    picture, axes = plt.subplots(3, len(cases), figsize=(20, 8), sharex=True, layout="constrained")
    for column, (name, (method, factor)) in zip(axes.T, cases.items(), strict=True):
        result = joint_space_run(method, factor)
        run = result.run
        t, q, v = run.t, run.q[:, 0], run.v[:, 0]
        a = np.append(np.diff(v) / 0.01, np.nan)
        key = name.replace(": ", "_").replace(", ", "_").replace(" ", "")
        figure.data[key] = np.column_stack([t, q, v, a])
        jumps = np.abs(np.diff(a[:-1]))
        settled = t[:-2] > 1.5
        figure.metrics |= {
            f"{key}_violation_rad": float(result.vector("position_violation_rad")[0]),
            f"{key}_impact_rad_s": _impact(q, v, 2.0),
            f"{key}_chatter_rad_s2": float(jumps[settled].max()),
            f"{key}_times_at_limit": float(_visits(q, 2.0, 2e-4)),
        }
        column[0].plot(t, q)
        column[0].axhline(2.0, color="tab:red", linestyle="--")
        column[0].set(title=f"({name})", ylim=(0.0, 2.2))
        column[1].plot(t, v)
        for sign in (-1.0, 1.0):
            column[1].axhline(sign * 2.0, color="tab:red", linestyle="--")
            column[2].axhline(sign * 12.0, color="tab:red", linestyle="--")
        column[2].step(t, a, where="post")
        column[2].set(xlabel="time [s]")
    for axis, label in zip(
        axes[:, 0],
        ("position [rad]", "velocity [rad/s]", "acceleration [rad/s²]"),
        strict=True,
    ):
        axis.set_ylabel(label)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    figure.rows = _figure_4_rows(figure.metrics)
    figure.save(picture)
    return figure


def _impact(q: np.ndarray, v: np.ndarray, limit: float) -> float:
    """Return the velocity at which an upper limit is crossed, rad/s; 0 if it is not."""
    beyond = np.flatnonzero(q > limit + 1e-9)
    return float(v[beyond[0]]) if beyond.size else 0.0


def _visits(q: np.ndarray, limit: float, near: float) -> int:
    """Return how many times the joint comes to its limit."""
    at = q > limit - near
    return int(np.count_nonzero(at[1:] & ~at[:-1]) + at[0])


def _figure_4_rows(m: dict[str, float]) -> list[tuple[str, str, str, str]]:
    def broken(key: str) -> str:
        return f"by {m[f'{key}_violation_rad']:.3f} rad, at {m[f'{key}_impact_rad_s']:.2f} rad/s"

    def agrees(condition: bool) -> str:
        return "agrees" if condition else "DIFFERS"

    naive = [m[f"{key}_violation_rad"] > 1e-3 for key in ("a_naive_dt", "b_naive_2dt")]
    exact = max(m[f"{key}_violation_rad"] for key in ("c_exact_dt", "d_exact_2dt", "d_exact_5dt"))
    chatter = m["c_exact_dt_chatter_rad_s2"], m["d_exact_2dt_chatter_rad_s2"]
    softer = m["b_naive_5dt_impact_rad_s"] < m["a_naive_dt_impact_rad_s"]
    return [
        ("Fig. 4a: naive", "upper bound violated", broken("a_naive_dt"), agrees(naive[0])),
        (
            "Fig. 4b: naive, larger dt",
            "impact velocity reduced, still violated",
            f"2 dt {broken('b_naive_2dt')}; 5 dt {broken('b_naive_5dt')}",
            agrees(naive[1] and softer),
        ),
        (
            "Fig. 4c: exact",
            "bounds reached many times, never violated",
            f"largest violation {exact:.1e} rad; at the limit "
            f"{m['c_exact_dt_times_at_limit']:.0f} times",
            agrees(exact < 1e-6 and m["c_exact_dt_times_at_limit"] > 1),
        ),
        (
            "Fig. 4d: exact, larger dt",
            "the discontinuities of acceleration disappear",
            f"largest step of acceleration at rest {chatter[1]:.2g} rad/s² (4c: {chatter[0]:.2g})",
            agrees(chatter[1] < 0.01 * chatter[0]),
        ),
    ]


def figure_5() -> Figure:
    """Trajectory of the elbow in Cartesian torque control, naive and exact."""
    figure = Figure("paper0-fig5")
    cases = {
        "a: naive, 2 dt": ("naive", 2.0),
        "naive, 20 dt": ("naive", 20.0),
        "b: exact, 2 dt": ("exact", 2.0),
    }
    values = load_values("baxter_left_arm") | {"safety_filter": False}
    elbow = values["joints"].index("left_e1")
    low, dt = values["position_min"][elbow], 1.0 / values["rate_hz"]
    path = ROOT / "config" / "scenarios" / "baxter_left_arm_demo.yaml"
    scenario = yaml.safe_load(path.read_text())
    scenario = {"duration": 4.0, "events": scenario["events"][:1]}
    picture, axes = plt.subplots(3, 3, figsize=(14, 8), sharex=True, layout="constrained")
    for column, (name, (method, factor)) in zip(axes.T, cases.items(), strict=True):
        own = {"method": method, "bounds_dt_factor": factor}
        result = run_chain(values | own, scenario, {})
        run = result.run
        t, q, v = run.t, run.q[:, elbow], run.v[:, elbow]
        crossed = np.flatnonzero(q < low)
        key = name.split(": ")[-1].replace(", ", "_").replace(" ", "")
        figure.data[key] = np.column_stack([t, q, v, run.a_lower[:, elbow], run.a_upper[:, elbow]])
        figure.metrics |= {
            f"{key}_violation_rad": float(result.vector("position_violation_rad").max()),
            f"{key}_impact_time_s": float(t[crossed[0]]) if crossed.size else float("nan"),
            f"{key}_impact_rad_s": float(v[crossed[0]]) if crossed.size else 0.0,
            f"{key}_closest_rad": float((q - low).min()),
            f"{key}_speed_at_closest_rad_s": float(abs(v[np.argmin(q)])),
            f"{key}_torque_ratio": float(result.vector("torque_ratio").max()),
        }
        column[0].plot(t, q)
        column[0].axhline(low, color="tab:red", linestyle="--")
        column[0].set(title=f"({name})", ylim=(-0.2, 0.6))
        column[1].plot(t, v)
        for sign in (-1.0, 1.0):
            limit = sign * values["velocity_max"][elbow]
            column[1].axhline(limit, color="tab:red", linestyle="--")
        column[2].fill_between(
            t, run.a_lower[:, elbow], run.a_upper[:, elbow], alpha=0.25, label="allowed"
        )
        column[2].plot(t[:-1], np.diff(v) / dt, linewidth=1.0, label="measured")
        column[2].set(xlabel="time [s]")
    axes[2, 0].legend(loc="upper right")
    labels = ("elbow position [rad]", "elbow velocity [rad/s]", "elbow acceleration [rad/s²]")
    for axis, label in zip(axes[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    m = figure.metrics
    gentler = abs(m["naive_20dt_impact_rad_s"]) < 0.5 * abs(m["naive_2dt_impact_rad_s"])
    figure.rows = [
        (
            "Fig. 5a: naive, 2 dt",
            "elbow hits its lower bound at 0.36 s at -1.4 rad/s",
            f"at {m['naive_2dt_impact_time_s']:.2f} s at {m['naive_2dt_impact_rad_s']:.2f} rad/s",
            "agrees qualitatively; poses and acceleration limits are not in the paper",
        ),
        (
            "Fig. 5: naive, 20 dt",
            "still hits, at 0.3 rad/s",
            f"at {abs(m['naive_20dt_impact_rad_s']):.2f} rad/s",
            "agrees qualitatively" if gentler and m["naive_20dt_impact_rad_s"] < 0 else "DIFFERS",
        ),
        (
            "Fig. 5b: exact, 2 dt",
            "reaches the bound with zero velocity",
            f"{1e3 * m['exact_2dt_closest_rad']:.2f} mrad before it, at "
            f"{m['exact_2dt_speed_at_closest_rad_s']:.1e} rad/s",
            "agrees" if m["exact_2dt_violation_rad"] == 0.0 else "DIFFERS",
        ),
    ]
    figure.save(picture)
    return figure


def algorithm_4() -> Figure:
    """Time Algorithm 4 with the paper's number of samples; compare it with the refined search."""
    figure = Figure("paper0-alg4")
    values = load_values("baxter_left_arm")
    joints = values["joints"]
    model = build_model(read_urdf(values["robot_description"]), joints)
    limits = [values[key] for key in ("position_min", "position_max", "velocity_max")]
    picture, axes = joint_axes(joints, "evaluations N", "smallest limit found [rad/s²]")
    found = {}
    for method, most in (("sampling", 6), ("refined", 4)):
        evaluations, tightest = [], []
        for samples in np.logspace(2, most, most - 1, dtype=int).tolist():
            start = time.perf_counter()
            worst = estimate_acceleration_limits(
                model,
                *limits,
                values["torque_max"],
                samples=samples,
                method=method,
                overrides={"left_s1": (-3.0, 3.0)},
            ).worst
            figure.metrics[f"{method}_seconds"] = time.perf_counter() - start
            evaluations.append(worst.evaluations)
            tightest.append(worst.room.min(axis=0))
        tightest = np.array(tightest)
        found[method] = tightest[-1]
        figure.data[method] = np.column_stack([evaluations, tightest])
        for j, axis in enumerate(axes):
            axis.semilogx(evaluations, tightest[:, j], marker=".", label=method)
    axes[0].legend()
    tighter = bool((found["refined"] <= found["sampling"]).all())
    share = float(np.delete(found["refined"] / found["sampling"], joints.index("left_s1")).min())
    figure.metrics |= {"refined_is_tighter": tighter, "smallest_ratio": share}
    figure.rows = [
        (
            "Algorithm 4, N = 1e6",
            "about 5 minutes",
            f"{figure.metrics['sampling_seconds']:.1f} s",
            "faster; left_s1 has no interval: see config/baxter_left_arm.yaml",
        ),
        (
            "Beyond it: refined search, N = 1e4",
            "-",
            f"{figure.metrics['refined_seconds']:.1f} s; limits down to {share:.0%} of those that "
            "N = 1e6 samples found",
            "tighter" if tighter else "DIFFERS: a limit is wider",
        ),
    ]
    figure.save(picture)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "fig1": figure_1,
    "fig3": figure_3,
    "fig4": figure_4,
    "fig5": figure_5,
    "alg4": algorithm_4,
}


def write_document(figures: list[Figure]) -> None:
    """Write the table of docs/results.md."""
    write_part("paper0", table(figures))


if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, FIGURES, write_document))
