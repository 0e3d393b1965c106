# SPDX-License-Identifier: Apache-2.0
"""Figures and tables of the pages under docs/theory.

bash scripts/reproduce.sh theory             all of them
bash scripts/reproduce.sh theory bounds      one figure
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import closing

import matplotlib.pyplot as plt
import numpy as np
from chain import ROOT, load_node_values
from figure import Figure, reproduce
from speed_limits import speed_limits

from viability_bounds_pkg import viability
from viability_bounds_pkg.baselines import naive_bounds
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.observer import Observer, design_observer

sys.path.insert(0, f"{ROOT}/src/sim_bridge/test/support")

from stopped_robot import Stopped

ROBOTS = {"Panda": "panda", "TALOS": "talos_left_arm", "Baxter": "baxter_left_arm"}
RED, GREEN = "tab:red", "tab:green"
HEADS = ("what", "here", "")


def bounds() -> Figure:
    """One joint that is sent beyond its limit, with usual bounds and with exact ones."""
    figure = Figure("theory-bounds", heads=HEADS)
    limits, dt, goal = JointLimits(("joint",), [-1.0], [1.0], [2.0], [-10.0], [10.0]), 0.01, 1.2
    picture, axes = plt.subplots(1, 3, figsize=(11.5, 3.8), layout="constrained")
    place = np.linspace(-1.0, 1.0, 801)
    low, high = viability.viable_velocity_range(place[:, None], limits)
    axes[0].fill_between(place, low[:, 0], high[:, 0], color=GREEN, alpha=0.15, lw=0)
    axes[0].text(-0.95, 0.05, "the joint can still\nkeep its limits", fontsize=9)
    for name, of, color in (
        ("usual bounds", naive_bounds, RED),
        ("exact bounds", viability.acceleration_bounds, GREEN),
    ):
        q, v, rows = np.zeros(1), np.zeros(1), []
        for k in range(130):
            allowed = of(q, v, limits, 2.0 * dt)  # as the files have it, bounds_dt_factor 2
            lower, upper = allowed.lower, allowed.upper
            a = np.clip(400.0 * (goal - q) - 40.0 * v, lower, upper)
            rows.append((k * dt, q[0], v[0], a[0], lower[0], upper[0]))
            q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
        t, q_all, v_all, a_all, lower_all, upper_all = np.array(rows).T
        figure.data[name] = np.array(rows)
        figure.metrics[f"{name}: beyond_rad"] = float(max(q_all.max() - 1.0, 0.0))
        axes[0].plot(q_all, v_all, color=color, label=name)
        axes[1].plot(t, q_all, color=color, label=name)
        axes[2].step(t, a_all, where="post", color=color, label=name)
        if color == GREEN:
            ends = lower_all, upper_all
            axes[2].fill_between(t, *ends, step="post", color=GREEN, alpha=0.15, lw=0)
    axes[0].axvline(1.0, color="k", ls="--", lw=1)
    axes[0].set(xlim=(-1.05, 1.3), ylim=(-2.2, 2.2), xlabel="position, rad", ylabel="speed, rad/s")
    axes[1].axhline(1.0, color="k", ls="--", lw=1)
    axes[1].set(xlabel="time, s", ylabel="position, rad; dashed: its limit")
    axes[2].set(xlabel="time, s", ylabel="acceleration, rad/s²; shaded: exact")
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(loc="lower left", fontsize=9)
    usual, exact = figure.metrics.values()
    figure.add(
        "a joint with a goal 0.2 rad beyond its limit",
        f"usual bounds: {usual:.3f} rad beyond; exact bounds: {exact:.1e} rad",
        holds=exact < 1e-9,
        so="kept",
    )
    figure.save(picture, "bounds")
    return figure


STATES = 30
"""States of each robot from which it stops."""
STOP_HEADS = (
    "robot",
    "states",
    "brakes: states, rad, rad/s beyond",
    "coordinated stop: the same",
)
OBSERVER_HEADS = (
    "robot, its first joint",
    "Delta, rad",
    "W, rad/s²",
    "observer: largest error, rad/s",
    "observer: lag, ms",
    "differences: error of quantisation alone, rad/s",
)


def stopping() -> Figure:
    """Stops from the edge of the kernel: full brake torque beside the coordinated stop."""
    figure = Figure("theory-stopping", "theory-stopping", STOP_HEADS, "theory/whole_arm.md")
    for name, robot in ROBOTS.items():
        stopped = Stopped(robot)
        rng, worst = np.random.default_rng(0), {True: np.zeros(3), False: np.zeros(3)}
        with closing(stopped.robot):
            for _ in range(STATES):
                q, v = stopped.edge(rng)
                time = stopped.law.time_to_rest(v) + 0.05
                for brake, found in worst.items():
                    position, speed = stopped.play(q, v, time, brake=brake)
                    found[0] += position > 0.0 or speed > 0.0
                    found[1:] = np.maximum(found[1:], (position, speed))
        brakes, stop = (f"{n:.0f}, {q:.2g}, {v:.2g}" for n, q, v in worst.values())
        # Baxter's shoulder cannot always give what is assumed.
        kept = name == "Baxter" or worst[False][0] == 0.0
        figure.add(name, str(STATES), brakes, holds=kept, so=stop)
    figure.save(_speeds(), "stopping")
    return figure


def _speeds() -> plt.Figure:
    """Draw the speeds of Panda's joints in a stop, by brakes and by the law."""
    stopped = Stopped("panda")
    picture, axes = plt.subplots(1, 2, figsize=(10, 3.4), sharey=True, layout="constrained")
    with closing(stopped.robot):
        rng, law = np.random.default_rng(0), stopped.law
        q, v = max(
            (stopped.edge(rng) for _ in range(STATES)),
            key=lambda state: stopped.play(*state, law.time_to_rest(state[1]), brake=True)[1],
        )
        durations = 0.06, law.time_to_rest(v) + 0.05
        for axis, brake, duration in zip(axes, (True, False), durations, strict=True):
            stopped.robot.reset(q, v)
            law.start(q, v)
            speeds = [v]
            for _ in range(round(duration / stopped.dt)):
                if brake:
                    stopped.robot.brake(1, stopped.config.torque_max)
                else:
                    stopped.robot.stop(law, 1)
                speeds.append(stopped.robot.state().v)
            t = np.arange(len(speeds)) * stopped.dt
            lines = axis.plot(t, np.array(speeds) / stopped.config.velocity_max)
            axis.axhspan(-1.0, 1.0, color=GREEN, alpha=0.12, lw=0)
            axis.set(xlabel="time, s", title="full brake torque" if brake else "coordinated stop")
            axis.grid(alpha=0.3)
    axes[0].set(ylabel="speed of each joint, of its limit")
    axes[1].legend(lines, stopped.config.joints, fontsize=8, loc="upper right")
    return picture


def estimator() -> Figure:
    """A joint with a coarse encoder and late commands: differences beside the observer."""
    name = "theory-estimator"
    figure = Figure(name, name, OBSERVER_HEADS, "theory/estimator.md")
    for name, robot in ROBOTS.items():
        own = load_node_values(robot, f"imperfect/{robot}")["estimator_node"]
        delta, w = (own[key][0] for key in ("position_error", "acceleration_disturbance"))
        dt = 1.0 / own["rate_hz"]
        design = design_observer(dt, delta, w)
        pole = float(np.sqrt(1.0 - design.position_gain[0]))
        lag = dt * (2.0 / (1.0 - pole) - 1.5)
        figure.rows.append(
            (
                name,
                f"{delta:.2g}",
                f"{w:g}",
                f"{design.velocity_error[0]:.3f}",
                f"{1e3 * lag:.1f}",
                f"{2.0 * delta / dt:.3f}",
            )
        )
    dt, delay, w, step = 0.002, 2, 1.0, 9.6e-5
    design = design_observer(dt, 0.5 * step, w)
    observer, state, rows = Observer(design, dt, np.zeros(1)), State(np.zeros(1), np.zeros(1)), []
    commands = [float(15.0 * np.cos(2.0 * np.pi * k * dt / 0.5)) for k in range(500)]
    states = [state]
    for k in range(500):
        unknown = w if (k // 60) % 2 else -w
        states.append(states[-1].after(np.array([commands[k] + unknown]), dt))
    last = 0.0
    for k in range(delay, 500):
        # The state of instant k - delay is known at k, and the command sent at k acts at once.
        measured = step * np.round(states[k - delay].q / step)
        if k > delay:
            observer.predict(np.array([commands[k - delay - 1]]))
        observer.correct(observer.innovation(measured))
        coming = observer.state
        for j in range(k - delay, k):
            coming = coming.after(np.array([commands[j]]), dt)
        true = states[k].v[0]
        rows.append((k * dt, true, (measured[0] - last) / dt, coming.v[0]))
        last = measured[0]
    t, true, difference, estimate = np.array(rows)[50:].T
    bound = float(design.velocity_error[0]) + w * delay * dt
    figure.data["t, true, difference, estimate"] = np.array(rows)
    picture, axes = plt.subplots(1, 2, figsize=(10, 3.7), layout="constrained")
    axes[0].plot(t, difference, color=RED, lw=0.8, label="difference of positions, as reported")
    axes[0].plot(t, true, color="k", lw=2.5, label="true, when the command acts")
    axes[0].plot(t, estimate, color=GREEN, lw=1.2, label="estimated and predicted")
    axes[0].set(ylabel="speed, rad/s")
    axes[1].plot(t, difference - true, color=RED, lw=0.8)
    axes[1].plot(t, estimate - true, color=GREEN)
    for sign in (-1.0, 1.0):
        axes[1].axhline(sign * bound, color="k", ls="--", lw=1)
    axes[1].set(ylabel="error, rad/s; dashed: guaranteed")
    for axis in axes:
        axis.set(xlabel="time, s", xlim=(0.1, 0.6))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=9, loc="upper right")
    within = bool((np.abs(estimate - true) <= bound).all())
    figure.metrics = {"largest_error_rad_s": float(np.abs(estimate - true).max()), "bound": bound}
    if not within:
        raise SystemExit("error: the estimate is off by more than is guaranteed")
    figure.save(picture, "estimator")
    return figure


PARTS: dict[str, Callable[[], Figure]] = {
    "bounds": bounds,
    "speed_limits": speed_limits,
    "stopping": stopping,
    "estimator": estimator,
}

if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, PARTS))
