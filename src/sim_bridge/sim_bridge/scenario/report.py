# SPDX-License-Identifier: Apache-2.0
"""The report of a run: table, verdict, figure, data and metrics."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.scenario.events import EnableTorque, Event, PoseGoal, TrajectoryGoal
from sim_bridge.scenario.scenario import ScenarioConfiguration
from viability_bounds_pkg.joint_limits import speed_limits
from viability_bounds_pkg.robot.urdf_joints import units_of

Array = NDArray[np.float64]
Metrics = dict[str, Any]

TOLERANCE = 1e-9
"""Of a violation, rad, rad/s and share of the torque limit: excludes rounding."""

_RECORDED = ("t", "q", "v", "a_lower", "a_upper", "tau", "ft_wrench")


@dataclass(frozen=True)
class RecordedRun:
    """A recorded run; arrays of all N control periods by n joints, NaN where a message was lost.

    Attributes:
        joints: names, n of them.
        t: shape (N,), s of robot time from the first state.
        q, v: position and velocity, rad and rad/s.
        a_lower, a_upper: acceleration limits, rad/s^2.
        tau: commanded torque, N m; NaN under position control too.
        ft_wrench: of the force/torque sensor, force and torque, N and N m, shape (N, 6); NaN
            without a sensor.
        answered: whether there was a command, shape (N,).
    """

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    a_lower: Array
    a_upper: Array
    tau: Array
    ft_wrench: Array
    answered: NDArray[np.bool_]

    @property
    def lost(self) -> int:
        """Number of periods without recorded state, limits or command."""
        without = np.isnan(self.q[:, 0]) | np.isnan(self.a_lower[:, 0]) | ~self.answered
        return int(without.sum())


def write_report(
    directory: Path,
    config: ScenarioConfiguration,
    run: RecordedRun,
    diagnostics: Mapping[str, Mapping[str, str]],
) -> bool:
    """Write ``figure.png``, ``data.npz`` and ``metrics.json``; print a table and the verdict.

    Args:
        directory: created if it does not exist.
        config: scenario and arm.
        run: the recording.
        diagnostics: the last ones of each node, by key; the robot's cover every physics step.

    Returns:
        Whether every limit was kept.

    Raises:
        OSError: the files cannot be written.
    """
    reference = pose_reference(config.plan.events, run.t)
    errors = _errors(config, run, reference)
    metrics = _metrics(config, run, errors, diagnostics)
    _print_table(metrics)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            directory / "data.npz",
            joints=np.array(run.joints),
            position_error=errors[:, 0],
            orientation_error=errors[:, 1],
            pose_reference=reference,
            **{name: getattr(run, name) for name in _RECORDED},
        )
        (directory / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
        _draw(directory / "figure.png", config, run, errors, metrics)
    except OSError as error:
        raise OSError(f"no report in {directory}: {error.strerror or error}") from error
    print(f"figure, data and metrics are in {directory}")
    return bool(metrics["limits_kept"])


def pose_reference(events: Iterable[Event], t: Array) -> Array:
    """Return the pose that the scenario asks of the end effector, in the base frame.

    The end effector of a compliant arm, or of one that avoids collisions, may be elsewhere.

    Args:
        events: in order of time.
        t: times, s, shape (N,).

    Returns:
        Position and quaternion x, y, z, w, shape (N, 7); NaN before the first pose or trajectory,
        and from a change to or from position control on until the next that comes under torque
        control.
    """
    reference = np.full((len(t), 7), np.nan)
    torque = True
    for event in events:
        now = np.flatnonzero(t >= event.time - 1e-9)
        if isinstance(event, EnableTorque):
            torque = event.enable
            reference[now] = np.nan
        elif torque and isinstance(event, PoseGoal):
            reference[now] = [*event.position, *event.orientation]
        elif torque and isinstance(event, TrajectoryGoal):
            for i in now:
                reference[i] = pin.SE3ToXYZQUAT(event.trajectory.sample(t[i] - event.time)[0])
    return reference


def _errors(config: ScenarioConfiguration, run: RecordedRun, reference: Array) -> Array:
    """Return distance and angle of each state to the reference, shape (N, 2), m and rad.

    NaN without a reference. The forward kinematics are PyBullet's, which share nothing with the
    controller's.
    """
    errors = np.full((len(run.t), 2), np.nan)
    rest = np.zeros(len(run.joints))
    with closing(
        BulletRobot(config.urdf, config.joints, locked_positions=config.locked, physics_dt=1e-3)
    ) as robot:
        base = robot.link_pose(config.base_frame)
        for i in np.flatnonzero(np.isfinite(reference[:, 0]) & np.isfinite(run.q[:, 0])):
            robot.reset(run.q[i], rest)
            pose = robot.link_pose(config.end_effectors[0])
            desired = base * pin.XYZQUATToSE3(reference[i])
            turn = pin.log3(pose.rotation.T @ desired.rotation)
            distance = np.linalg.norm(desired.translation - pose.translation)
            errors[i] = distance, np.linalg.norm(turn)
    return errors


def _floats(robot: Mapping[str, str], key: str) -> Array:
    return np.array([float(item) for item in robot[key].split()])


def _or_none(value: float) -> float | None:
    """Return None, which JSON has, for NaN: without a pose goal there is no error."""
    return float(value) if np.isfinite(value) else None


def _metrics(
    config: ScenarioConfiguration,
    run: RecordedRun,
    errors: Array,
    diagnostics: Mapping[str, Mapping[str, str]],
) -> Metrics:
    robot, bounds, controller = (
        diagnostics[name] for name in (config.robot_node, "bounds_node", "controller_node")
    )
    worst = np.nan  # distance to a trajectory while it lasted
    for event in config.plan.events:
        if isinstance(event, TrajectoryGoal):
            during = (run.t >= event.time) & (run.t <= event.time + event.trajectory.duration)
            worst = np.fmax(worst, np.fmax.reduce(errors[during, 0], initial=np.nan))
    position = _floats(robot, "position_violation_rad")
    velocity = _floats(robot, "velocity_violation_rad_s")
    ratio = max(float(robot["commanded_torque_ratio_max"]), _floats(robot, "torque_ratio").max())
    rate = _floats(robot, "torque_rate_ratio").max() if "torque_rate_ratio" in robot else None
    kept = position.max() <= TOLERANCE and velocity.max() <= TOLERANCE and ratio <= 1.0 + TOLERANCE
    kept = kept and (rate is None or rate <= 1.0 + TOLERANCE)
    return {
        "robot": config.robot_name,
        "bounds_method": bounds.get("method", "unknown"),
        "torque_rates_clipped": controller.get("torque_rate_max") == "clipped",
        "clock": robot["clock"],
        "rate_hz": 1.0 / float(robot["period_s"]),
        "measured_rate_hz": float(robot["rate_hz"]),
        "steps": int(robot["periods"]),
        "physics_steps_per_period": int(robot["physics_steps_per_period"]),
        "limits_kept": bool(kept),
        "max_position_violation_rad": float(position.max()),
        "most_violated_joint": (
            run.joints[int(np.argmax(position))] if position.max() > TOLERANCE else None
        ),
        "max_velocity_violation_rad_s": float(velocity.max()),
        "most_too_fast_joint": (
            run.joints[int(np.argmax(velocity))] if velocity.max() > TOLERANCE else None
        ),
        "max_torque_ratio": float(ratio),
        "max_torque_rate_ratio": None if rate is None else _or_none(rate),
        "bounds_relaxed_steps": int(controller.get("bounds_relaxed_steps", 0)),
        "final_position_error_m": _or_none(errors[-1, 0]),
        "final_orientation_error_rad": _or_none(errors[-1, 1]),
        "max_trajectory_error_m": _or_none(worst),
        "max_contact_force_n": _or_none(float(robot.get("contact_force_max_n", "nan"))),
        "deadline_misses": int(robot["deadline_misses"]),
        "late_periods": int(robot["late_periods"]),
        "braked_periods": int(robot["braked_periods"]),
        "latency_p50_us": _or_none(float(robot["latency_p50_us"])),
        "latency_p99_us": _or_none(float(robot["latency_p99_us"])),
        "recording_lost_periods": run.lost,
        "joints": {
            name: {
                "unit": unit,
                "lower_clearance_rad": low,
                "upper_clearance_rad": high,
                "max_speed_ratio": speed,
                "max_torque_ratio": torque,
            }
            for name, unit, low, high, speed, torque in zip(
                run.joints,
                units_of(config.urdf, run.joints),
                _floats(robot, "lower_clearance_rad").tolist(),
                _floats(robot, "upper_clearance_rad").tolist(),
                (np.fmax.reduce(np.abs(run.v)) / config.velocity_max).tolist(),
                _floats(robot, "torque_ratio").tolist(),
                strict=True,
            )
        },
    }


def _print_table(metrics: Metrics) -> None:
    print()
    width = max(map(len, metrics["joints"]))
    print(f"{'joint':<{width}}  to lower limit  to upper limit  top speed  top torque")
    unit = _units(metrics)
    print(f"{'':<{width}}{unit:>16}{unit:>16}  of limit     of limit")
    for name, row in metrics["joints"].items():
        print(
            f"{name:<{width}}  {row['lower_clearance_rad']:+14.6f}  "
            f"{row['upper_clearance_rad']:+14.6f}  {row['max_speed_ratio']:9.1%}  "
            f"{row['max_torque_ratio']:10.1%}"
        )
    print()
    if metrics["final_position_error_m"] is not None:
        print(
            f"pose error at the end: {1e3 * metrics['final_position_error_m']:.3f} mm, "
            f"{1e3 * metrics['final_orientation_error_rad']:.3f} mrad"
        )
    if metrics["max_trajectory_error_m"] is not None:
        print(f"off the trajectory: {1e3 * metrics['max_trajectory_error_m']:.3f} mm at most")
    if metrics["max_contact_force_n"]:
        print(f"contact force with obstacles: {metrics['max_contact_force_n']:.1f} N at most")
    periods = f"{metrics['steps']} control periods"
    if metrics["latency_p50_us"] is not None:
        periods += (
            f", command latency {metrics['latency_p50_us']:.0f} us (median), "
            f"{metrics['latency_p99_us']:.0f} us (99%)"
        )
    print(periods)
    print(f"VERDICT: {verdict(metrics)}")


def _units(metrics: Metrics) -> str:
    """Return the units of the joints' positions."""
    return " or ".join(dict.fromkeys(row["unit"] for row in metrics["joints"].values()))


def verdict(metrics: Metrics) -> str:
    """Return which limits were broken, if any, and whether every command came in time.

    Args:
        metrics: as in ``metrics.json``.
    """
    q, v = metrics["max_position_violation_rad"], metrics["max_velocity_violation_rad_s"]
    tau, rate = metrics["max_torque_ratio"], metrics["max_torque_rate_ratio"] or 0.0
    unit = {name: row["unit"] for name, row in metrics["joints"].items()}
    beyond, fast = metrics["most_violated_joint"], metrics["most_too_fast_joint"]
    broken = {
        f"position by {q:.4g} {unit.get(beyond)} ({beyond})": q > TOLERANCE,
        f"speed by {v:.4g} {unit.get(fast)}/s ({fast})": v > TOLERANCE,
        f"torque, {tau:.4g} of its limit": tau > 1.0 + TOLERANCE,
        f"torque rate, {rate:.4g} of its limit": rate > 1.0 + TOLERANCE,
    }
    said = "no limit was broken, at any physics step"
    if not metrics["limits_kept"]:
        said = f"limits were BROKEN: {'; '.join(text for text in broken if broken[text])}"
    missed, braked, steps = (
        metrics[key] for key in ("deadline_misses", "braked_periods", "steps")
    )
    if metrics["clock"] == "real_time" or missed:
        said += f"; {missed} of {steps} deadlines were missed"
    if late := metrics["late_periods"]:
        said += f"; the simulation itself was late by {late} periods"
    if braked:
        said += f"; the robot braked without commands for {braked} of {steps} periods"
    exact = metrics["bounds_method"] == "exact"  # the others promise nothing
    if exact and not metrics["limits_kept"] and (missed or braked):
        said += (
            ": the promise needs a command in every period (give the nodes their own cores, or "
            "lower rate_hz)"
        )
    if lost := metrics["recording_lost_periods"]:
        said += f"; the recording lacks messages of {lost} of {steps} periods"
    if metrics["torque_rates_clipped"]:
        said += "; torque_rate_max is clipped: limits are not promised with it"
    return said + "."


_LIMIT = {"color": "tab:red", "linestyle": "--", "linewidth": 1.2}


def _draw(
    path: Path, config: ScenarioConfiguration, run: RecordedRun, errors: Array, metrics: Metrics
) -> None:
    """Draw the joint nearest to a limit on the left, all relative to their limits on the right."""
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(12, 10), layout="constrained")
    axes = figure.subplots(4, 2, sharex=True)
    outcome = "no limit broken" if metrics["limits_kept"] else "LIMITS BROKEN"
    figure.suptitle(
        f"{config.robot_name}: {metrics['bounds_method']} bounds, {metrics['rate_hz']:g} Hz, "
        f"{metrics['clock']}: {outcome}"
    )
    low, high = config.position_min, config.position_max
    j = int(np.argmin(np.fmin.reduce(np.minimum(run.q - low, high - run.q))))
    of_joint = units_of(config.urdf, run.joints)[j]
    force = "N m" if of_joint == "rad" else "N"
    for (left, right), (name, unit, values, lower, upper) in zip(
        axes[:3],
        (
            ("position", of_joint, run.q, low, high),
            ("velocity", f"{of_joint}/s", run.v, -config.velocity_max, config.velocity_max),
            (
                "torque",
                force,
                run.tau,
                -config.torque_max,
                config.torque_max,
            ),
        ),
        strict=True,
    ):
        left.plot(run.t, values[:, j])
        with np.errstate(invalid="ignore"):  # joints without limits are left out
            right.plot(run.t, (2.0 * values - lower - upper) / (upper - lower))
        left.set(ylabel=f"{name} [{unit}]")
        right.set(ylabel=f"{name} / limit")
        for axis, limits in ((left, (lower[j], upper[j])), (right, (-1.0, 1.0))):
            for limit in limits:
                axis.axhline(limit, **_LIMIT)
    rooms = np.stack([run.q - low, high - run.q])
    speeds = config.velocity_max, config.velocity_offset, config.deceleration_limit
    for sign, limit in zip((-1.0, 1.0), speed_limits(rooms, *speeds), strict=True):
        axes[1, 0].plot(run.t, sign * limit[:, j], **_LIMIT)  # where it depends on position
    axes[0, 0].set(title=f"{run.joints[j]}, the joint nearest to a limit")
    axes[0, 1].set(title="all joints, limits at -1 and 1")
    axes[0, 1].legend(run.joints, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    acceleration, error = axes[3]
    acceleration.fill_between(
        run.t, run.a_lower[:, j], run.a_upper[:, j], alpha=0.25, label="allowed"
    )
    measured = np.diff(run.v[:, j]) * metrics["rate_hz"]
    acceleration.plot(run.t[:-1], measured, linewidth=1.0, label="measured")
    acceleration.set(ylabel=f"acceleration [{of_joint}/s$^2$]", xlabel="time [s]")
    for values, label in zip(errors.T, ("position [mm]", "orientation [mrad]"), strict=True):
        error.semilogy(run.t, np.maximum(1e3 * values, 1e-3), label=label)
    error.set(ylabel="error of the pose goal", xlabel="time [s]")
    for axis in axes[3]:
        axis.legend(loc="upper right")
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
