# SPDX-License-Identifier: Apache-2.0
"""Figures 1, 3, 4 and 5 and the timing of Algorithm 4 of [DelPrete2018], and a table beside it.

bash scripts/reproduce.sh paper0         all of it, and a table of docs/results.md
bash scripts/reproduce.sh paper0 fig5    one figure
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
import yaml
from chain import ROOT, load_values, run_chain
from figure import Figure, reproduce
from matplotlib.colors import BoundaryNorm, ListedColormap

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.acceleration_limits import estimate_acceleration_limits
from viability_bounds_pkg.estimate.worst_case import StateSpace, search_by_sampling
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf

sys.path.insert(0, f"{ROOT}/src/viability_bounds_pkg/test/support")

import paper_algorithms

PART = "paper0"
SAMPLES, TURNS = 1_000_000, 10
"""Of Algorithm 4 beside a plain loop."""


def one_joint(q: float, v: float, a: float) -> JointLimits:
    """Return symmetric limits of one joint."""
    return JointLimits(("joint",), [-q], [q], [v], [-a], [a])


def figure_1() -> Figure:
    """State-space plot of the viability constraints of this paper, [5] and [6]."""
    figure = Figure("paper0-fig1", PART)
    limits, dt = one_joint(1.0, 5.0, 15.0), 0.1
    q = np.linspace(-1.0, 1.0, 2001)
    column = q[:, None]
    curves = {
        "viability, this paper": viability.viable_velocity_range(column, limits),
        "Decré et al. [6]": baselines.decre_velocity_range(column, limits, dt),
        "Rubrecht et al. [5]": baselines.rubrecht_velocity_range(column, limits, dt),
    }
    picture, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    for k, (name, (low, high)) in enumerate(curves.items()):
        axis.plot(q, high[:, 0], color=f"C{k}", linewidth=1.5 if k else 4.0, label=name)
        axis.plot(q, low[:, 0], color=f"C{k}", linewidth=1.5 if k else 4.0)
        figure.data[name] = np.column_stack([q, low[:, 0], high[:, 0]])
    for sign in (-1.0, 1.0):
        axis.axhline(sign * 5.0, color="tab:red", linestyle="--")
        axis.axvline(sign, color="tab:red", linestyle="--")
    reach = np.sqrt(2.0 * 15.0 * (q + 1.0))
    axis.plot(q, np.minimum(reach, 9.0), "k:", label="reachable from rest at a limit")
    axis.plot(q, -np.minimum(reach[::-1], 9.0), "k:")
    axis.set(xlabel="q [rad]", ylabel="velocity [rad/s]", xlim=(-1.05, 1.05), ylim=(-6, 6))
    axis.set_title("q limits ±1 rad, velocity 5 rad/s, acceleration 15 rad/s²; dt 0.1 s")
    axis.legend(loc="lower left", fontsize="small")
    exact, rubrecht = (curves[name][1][:, 0] for name in list(curves)[::2])
    inside = bool((rubrecht <= exact + 1e-12).all())
    gap = figure.metrics["widest_gap_to_rubrecht_rad_s"] = float((exact - rubrecht).max())
    figure.add(
        "Fig. 1: [5] against the exact kernel",
        "inside it, conservative",
        f"inside it everywhere: {inside}; by up to {gap:.2f} rad/s",
        holds=inside,
    )
    figure.save(picture)
    return figure


def figure_3() -> Figure:
    """Regions of the state space by active acceleration bound."""
    figure = Figure("paper0-fig3", PART)
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
    figure.add(
        "Fig. 3: regions by active upper bound",
        "six regions: unreachable, not viable, and four bounds",
        ", ".join(f"{name} {value:.1%}" for name, value in share.items()),
        holds=min(share.values()) > 0.0,
        so="agrees: all six are present",
    )
    figure.save(picture)
    return figure


def draw_trajectory(
    axes: Sequence[plt.Axes],
    title: str,
    curves: tuple[np.ndarray, ...],
    q_limit: float,
    v_max: float,
) -> None:
    """Draw time, position, velocity and acceleration of a joint from above to below."""
    t, *values = curves
    limits = ([q_limit], [-v_max, v_max], [])
    labels = ("position [rad]", "velocity [rad/s]", "acceleration [rad/s²]")
    for axis, value, lines, label in zip(axes, values, limits, labels, strict=True):
        axis.plot(t[: value.size], value)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        for line in lines:
            axis.axhline(line, color="tab:red", linestyle="--")
    axes[0].set_title(title)
    axes[-1].set_xlabel("time [s]")


def play_figure_4(figure: Figure, axes: Sequence[plt.Axes], method: str, factor: float) -> None:
    """Drive Baxter's first joint 0.1 rad beyond its upper limit."""
    values = load_values("baxter_left_arm") | {"safety_filter": False}
    n, first = len(values["joints"]), values["joints"][0]
    values |= {
        "position_max": [2.0] + values["position_max"][1:],
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
    goal = dict(zip(values["joints"], values["start_positions"], strict=True)) | {first: 2.1}
    scenario = {"duration": 2.5, "events": [{"time": 0.0, "posture": goal}]}
    # Only here may a goal lie outside the limits.
    beyond = {"controller_node": {"position_max": [2.2] + values["position_max"][1:]}}
    result = run_chain(values, scenario, beyond)
    t, q, v = result.run.t, result.run.q[:, 0], result.run.v[:, 0]
    a = np.diff(v) / 0.01
    name = f"{method}_{factor:g}dt"
    near, past = q > 2.0 - 2e-4, np.flatnonzero(q > 2.0 + 1e-9)
    figure.data[name] = np.column_stack([t[:-1], q[:-1], v[:-1], a])
    figure.metrics |= {
        f"{name}_violation_rad": float(result.vector("position_violation_rad")[0]),
        f"{name}_impact_rad_s": float(v[past[0]]) if past.size else 0.0,
        f"{name}_chatter_rad_s2": float(np.abs(np.diff(a))[t[:-2] > 1.5].max()),
        f"{name}_times_at_limit": float(np.count_nonzero(near[1:] & ~near[:-1]) + near[0]),
    }
    draw_trajectory(axes, f"{method}, {factor:g} dt", (t, q, v, a), 2.0, 2.0)


def figure_4() -> Figure:
    """Trajectories of the first joint under four ways to bound accelerations."""
    figure = Figure("paper0-fig4", PART)
    cases = [(method, factor) for method in ("naive", "exact") for factor in (1.0, 2.0, 5.0)]
    picture, axes = plt.subplots(3, len(cases), figsize=(20, 8), sharex=True, layout="constrained")
    for column, (method, factor) in zip(axes.T, cases, strict=True):
        play_figure_4(figure, column, method, factor)
    m = figure.metrics

    def broken(name: str) -> str:
        return f"by {m[f'{name}_violation_rad']:.3f} rad, at {m[f'{name}_impact_rad_s']:.2f} rad/s"

    exact = max(m[f"exact_{factor}dt_violation_rad"] for factor in (1, 2, 5))
    chatter, times = m["exact_1dt_chatter_rad_s2"], m["exact_1dt_times_at_limit"]
    smooth = m["exact_2dt_chatter_rad_s2"]
    figure.add(
        "Fig. 4a: naive",
        "upper bound violated",
        broken("naive_1dt"),
        holds=m["naive_1dt_violation_rad"] > 1e-3,
    )
    figure.add(
        "Fig. 4b: naive, larger dt",
        "impact velocity reduced, still violated",
        f"2 dt {broken('naive_2dt')}; 5 dt {broken('naive_5dt')}",
        holds=m["naive_2dt_violation_rad"] > 1e-3
        and m["naive_5dt_impact_rad_s"] < m["naive_1dt_impact_rad_s"],
    )
    figure.add(
        "Fig. 4c: exact",
        "bounds reached many times, never violated",
        f"largest violation {exact:.1e} rad; at the limit {times:.0f} times",
        holds=exact < 1e-6 and times > 1,
    )
    figure.add(
        "Fig. 4d: exact, larger dt",
        "the discontinuities of acceleration disappear",
        f"largest step of acceleration at rest {smooth:.2g} rad/s² (4c: {chatter:.2g})",
        holds=smooth < 0.01 * chatter,
    )
    figure.save(picture)
    return figure


def figure_5() -> Figure:
    """Trajectory of the elbow in Cartesian torque control, naive and exact."""
    figure = Figure("paper0-fig5", PART)
    values = load_values("baxter_left_arm") | {"safety_filter": False}
    elbow = values["joints"].index("left_e1")
    low, v_max = values["position_min"][elbow], values["velocity_max"][elbow]
    path = ROOT / "config" / "scenarios" / "baxter_left_arm_demo.yaml"
    scenario = {"duration": 4.0, "events": yaml.safe_load(path.read_text())["events"][:1]}
    picture, axes = plt.subplots(3, 3, figsize=(14, 8), sharex=True, layout="constrained")
    found = {}
    cases = (("naive", 2.0), ("naive", 20.0), ("exact", 2.0))
    for column, (method, factor) in zip(axes.T, cases, strict=True):
        own = {"method": method, "bounds_dt_factor": factor}
        result = run_chain(values | own, scenario, {})
        run = result.run
        t, q, v = run.t, run.q[:, elbow], run.v[:, elbow]
        bounds = run.a_lower[:, elbow], run.a_upper[:, elbow]
        crossed = np.flatnonzero(q < low)
        first = crossed[0] if crossed.size else int(np.argmin(q))
        name = f"{method}_{factor:g}dt"
        found[name] = float(t[first]), float(v[first]), float((q - low).min())
        figure.data[name] = np.column_stack([t, q, v, *bounds])
        figure.metrics |= {
            f"{name}_violation_rad": float(result.vector("position_violation_rad").max()),
            f"{name}_nearest_s": found[name][0],
            f"{name}_nearest_rad_s": found[name][1],
            f"{name}_torque_ratio": float(result.vector("torque_ratio").max()),
        }
        a = np.diff(v) * values["rate_hz"]
        draw_trajectory(column, f"{method}, {factor:g} dt", (t, q, v, a), low, v_max)
        column[2].fill_between(t, *bounds, alpha=0.25, label="allowed")
        column[2].legend(loc="upper right")
    time_hit, hit, _ = found["naive_2dt"]
    gentle, (_, speed, room) = found["naive_20dt"][1], found["exact_2dt"]
    figure.add(
        "Fig. 5a: naive, 2 dt",
        "elbow hits its lower bound at 0.36 s at -1.4 rad/s",
        f"at {time_hit:.2f} s at {hit:.2f} rad/s",
        so="agrees qualitatively; poses and acceleration limits are not in the paper",
    )
    figure.add(
        "Fig. 5: naive, 20 dt",
        "still hits, at 0.3 rad/s",
        f"at {abs(gentle):.2f} rad/s",
        holds=0.0 > gentle > 0.5 * hit,
        so="agrees qualitatively",
    )
    figure.add(
        "Fig. 5b: exact, 2 dt",
        "reaches the bound with zero velocity",
        f"{1e3 * room:.2f} mrad before it, at {abs(speed):.1e} rad/s",
        holds=figure.metrics["exact_2dt_violation_rad"] == 0.0,
    )
    figure.save(picture)
    return figure


def plain_loop(model: pin.Model, space: StateSpace, samples: int) -> np.ndarray:
    """Return the limits of Algorithm 4 as a loop over the states of seed 0, shape (2, n)."""
    lower, upper = np.full(space.n, -np.inf), np.full(space.n, np.inf)
    data = model.createData()
    states = space.states(np.random.default_rng(0).random((samples, 2 * space.n)))
    for q, v in zip(*states, strict=True):
        inertia = pin.crba(model, data, q).diagonal()
        h = pin.nonLinearEffects(model, data, q, v)
        lower = np.maximum(lower, (-space.tau_max - h) / inertia)
        upper = np.minimum(upper, (space.tau_max - h) / inertia)
    return np.stack([lower, upper])


def beside_a_plain_loop(model: pin.Model, space: StateSpace) -> float:
    """Return Algorithm 4's processor time as a share of a plain loop's, 1e6 samples by turns."""
    times = np.zeros((TURNS, 2))
    for turn in times:
        begin = time.process_time()
        expected = plain_loop(model, space, SAMPLES // TURNS)
        middle = time.process_time()
        found = search_by_sampling(model, space, SAMPLES // TURNS, 0)
        turn[:] = middle - begin, time.process_time() - middle
        np.testing.assert_allclose([found.a_min, found.a_max], expected, rtol=1e-9)
    return float(np.median(times[:, 1] / times[:, 0]))


def algorithm_4() -> Figure:
    """Time Algorithm 4 with the paper's number of samples; compare it with the refined search."""
    figure = Figure("paper0-alg4", PART)
    values = load_values("baxter_left_arm")
    joints = values["joints"]
    model = build_model(read_urdf(values["robot_description"]), joints)
    limits = [values[key] for key in ("position_min", "position_max", "velocity_max")]
    picture, axes = plt.subplots(1, len(joints), figsize=(20, 3), layout="constrained")
    found, seconds = {}, {}
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
            seconds[method] = time.perf_counter() - start
            evaluations.append(worst.evaluations)
            tightest.append(worst.room.min(axis=0))
        found[method] = tightest[-1]
        figure.data[method] = np.column_stack([evaluations, tightest])
        for axis, joint, curve in zip(axes, joints, np.array(tightest).T, strict=True):
            axis.semilogx(evaluations, curve, marker=".", label=method)
            axis.set(xlabel="evaluations N", title=joint)
    axes[0].set_ylabel("smallest limit found [rad/s²]")
    axes[0].legend()
    shares = np.delete(found["refined"] / found["sampling"], joints.index("left_s1"))
    figure.metrics = {f"{method}_seconds": each for method, each in seconds.items()}
    figure.metrics["smallest_ratio"] = float(shares.min())
    space = StateSpace.of(model, *limits, tau_max=values["torque_max"])
    share = figure.metrics["share_of_plain_loop"] = beside_a_plain_loop(model, space)
    figure.add(
        "Algorithm 4, N = 1e6",
        "about 5 minutes",
        f"{seconds['sampling']:.1f} s; {share:.2f} of a plain loop's processor time, on all cores",
        holds=share <= 0.25,
        so="faster; left_s1 has no interval: see config/baxter_left_arm.yaml",
    )
    figure.add(
        "Beyond it: refined search, N = 1e4",
        "-",
        f"{seconds['refined']:.1f} s; limits down to {shares.min():.0%} of those that "
        "N = 1e6 samples found",
        holds=bool((found["refined"] <= found["sampling"]).all()),
        so="tighter",
    )
    figure.save(picture)
    return figure


FIGURES = {
    "fig1": figure_1,
    "fig3": figure_3,
    "fig4": figure_4,
    "fig5": figure_5,
    "alg4": algorithm_4,
}

if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, FIGURES))
