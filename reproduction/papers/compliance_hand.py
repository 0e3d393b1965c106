# SPDX-License-Identifier: Apache-2.0
"""Figure 9 of [Benallegue2021], dual compliance; and pressing on a table, sliding along it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from compliance_push import ELBOW, HAND, RAMP, ROBOT
from direct import DirectLoop, within_limits
from figure import Figure, verdict

from sim_bridge.bullet.obstacles import Obstacle
from torque_safety_controller.parts.contact.interaction import Interaction
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, TrajectoryPoint

DUAL = {"integral_action": "task", "yield_threshold": [10.0, 2.0]}
PULL = np.array([20.0, 0.0, 0.0])  # N
ELBOW_PUSH = np.array([60.0, 72.0, 37.0])  # N; the null space yields there
TARE = 0.5  # s
FORCE = 10.0  # N
GAP = 0.005  # m, from the fingertips to the table


class PressingHand(NamedTuple):
    """A hand that points down, to press with."""

    robot: str
    changed: dict[str, Any]
    """Parameters that differ from the file's."""
    axis: float
    """1 or -1: the fingers point along the end effector's z axis, or against it."""
    reach: float
    """Of the fingertips from the end effector's frame, m."""


PANDA = PressingHand(
    "panda",
    {"pose_kp": 400.0, "pose_kd": 40.0, "integral_action": "task", "integral_lambda": 50.0},
    1.0,
    0.1129,
)
# By inverse kinematics, in the middle of its ranges; with its friction known and compensated.
TALOS = PressingHand(
    ROBOT,
    {
        "integral_action": "task",
        "friction_compensation": 1.0,
        "start_positions": np.array(
            [-0.209, 0.226, -0.802, 1.374, -1.021, -1.425, -0.717, -0.421, -0.066]
        ),
    },
    -1.0,
    0.1816,
)
WITH_FILE = "so with the file's values"
SLIDE = np.array([0.0, 0.15, 0.0])  # m


class Led(NamedTuple):
    """What a hand did that was pulled and let go: a row for each control step."""

    t: np.ndarray
    place: np.ndarray
    """From where it began, shape (N, 3), m."""
    turn: np.ndarray
    """Likewise, shape (N,), rad."""
    joints: np.ndarray
    """Shape (N, n), rad."""
    force: np.ndarray
    """Measured at the hand, shape (N,), N."""
    state: list[str]
    loop: DirectLoop

    def at(self, t: float) -> int:
        """Return the step at time `t`, s."""
        return int(np.searchsorted(self.t, t - 1e-9))


def lead(
    pushes: list[tuple[float, float, str, np.ndarray]],
    duration: float,
    silent_at: float = np.inf,
    changed: Mapping[str, Any] | None = None,
    admittance: float | None = None,
) -> Led:
    """Push on TALOS' links, the sensor being tared before.

    Args:
        pushes: begin and end, s; the link; the force, N.
        duration: s.
        silent_at: when the sensor falls silent, s.
        changed: parameters that differ from the file's and `DUAL`.
        admittance: gain of (27) with which the hand yields, m/s^2 per N and rad/s^2 per N m; None
            for the controller's own.
    """
    loop = DirectLoop(ROBOT, DUAL | dict(changed or {}))
    interaction = loop.controller.find(Interaction)
    if admittance is not None:
        interaction.yield_kp = (admittance, admittance)
    start = loop.pose()
    rows = []

    def each(t: float) -> None:
        if abs(t - TARE) < 0.5 * loop.dt:
            interaction.sensor.tare()
        loop.sensing = t < silent_at
        loop.robot.clear_wrenches()
        for begin, end, link, force in pushes:
            if begin <= t < end:
                share = min(1.0, (t - begin) / RAMP)
                loop.robot.apply_wrench(link, share * force, np.zeros(3))
        pose = loop.pose()
        turn = np.linalg.norm(pin.log3(start.rotation.T @ pose.rotation))
        felt = np.linalg.norm(interaction.sensor.wrench[:3])
        rows.append((t, pose.translation - start.translation, turn, felt, interaction.state.value))

    samples = loop.run(duration, each)
    t, place, turn, force, state = zip(*rows, strict=True)
    joints = np.array([sample.q for sample in samples])
    return Led(
        np.array(t), np.array(place), np.array(turn), joints, np.array(force), list(state), loop
    )


def dual(figure: Figure) -> None:
    """Figure 9: the elbow pushed, the hand pulled, let go, and the elbow pushed once more."""
    pushes = [
        (1.0, 3.0, ELBOW, ELBOW_PUSH),
        (4.0, 6.0, HAND, PULL),
        (7.5, 9.5, ELBOW, -ELBOW_PUSH),
    ]
    led = lead(pushes, 10.5)
    distance = np.linalg.norm(led.place, axis=1)
    pulled, released = led.at(4.0), led.at(6.0)
    kept = np.linalg.norm(led.place[released:] - led.place[released], axis=1)
    null = np.abs(led.joints[led.at(1.0) : led.at(3.0)] - led.joints[led.at(1.0)]).max()
    figure.data = {
        "t": led.t,
        "place_m": led.place,
        "turn_rad": led.turn,
        "q": led.joints,
        "force_n": led.force,
        "yielding": np.array([state == "yielding" for state in led.state]),
    }
    figure.metrics = {
        "hand_while_elbow_pushed_m": float(distance[:pulled].max()),
        "hand_while_elbow_pushed_rad": float(led.turn[:pulled].max()),
        "joint_moved_by_elbow_push_rad": float(null),
        "hand_led_m": float(np.linalg.norm(led.place[released] - led.place[pulled])),
        "kept_after_release_m": float(kept[: led.at(7.5) - released].max()),
        "kept_while_elbow_pushed_again_m": float(kept.max()),
        "yielded_steps_but_for_the_pull": float(
            sum(s == "yielding" for t, s in zip(led.t, led.state, strict=True) if not 4 <= t < 6.1)
        ),
        "limits_kept": float(within_limits(led.loop)),
    }
    numbers = figure.metrics
    figure.rows = [
        (
            "Fig. 9",
            "the hand stays when the arm is pushed",
            f"elbow pushed with {np.linalg.norm(ELBOW_PUSH):.0f} N: hand within "
            f"{1e3 * numbers['hand_while_elbow_pushed_m']:.1f} mm, a joint moves by "
            f"{null:.2f} rad",
            verdict(
                numbers["hand_while_elbow_pushed_m"] < 0.005
                and numbers["hand_while_elbow_pushed_rad"] < np.radians(1.0)
                and null > 0.1
                and not numbers["yielded_steps_but_for_the_pull"],
                WITH_FILE,
            ),
        ),
        (
            "Fig. 9",
            "moved freely when the hand itself is; its new place is kept",
            f"{PULL[0]:.0f} N move it by {1e3 * numbers['hand_led_m']:.0f} mm in 2 s; kept within "
            f"{1e3 * numbers['kept_after_release_m']:.1f} mm when let go, "
            f"{1e3 * numbers['kept_while_elbow_pushed_again_m']:.1f} mm when the elbow is pushed "
            "again",
            verdict(
                numbers["hand_led_m"] > 0.02
                and numbers["kept_while_elbow_pushed_again_m"] < 0.005
                and bool(numbers["limits_kept"]),
                WITH_FILE,
            ),
        ),
    ]
    figure.save(_draw_dual(led, pushes))


def _draw_dual(led: Led, pushes: list[tuple[float, float, str, np.ndarray]]) -> plt.Figure:
    picture, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    for axis in axes:
        for begin, end, link, _ in pushes:
            axis.axvspan(
                begin, end, color="tab:orange" if link == HAND else "0.85", alpha=0.4, lw=0
            )
    for column, name in enumerate("xyz"):
        axes[0].plot(led.t, 1e3 * led.place[:, column], label=name)
    axes[0].set_ylabel("hand, from its start [mm]")
    axes[0].legend(loc="upper left", ncols=3)
    moved = led.joints - led.joints[0]
    most = np.abs(moved).max(axis=0).argsort()[-3:]
    for joint in most:
        axes[1].plot(led.t, moved[:, joint], label=led.loop.config.joints[joint])
    axes[1].set_ylabel("joints that move most [rad]")
    axes[1].legend(loc="upper left")
    axes[2].plot(led.t, led.force, label="measured at the hand", lw=0.8)
    yielding = np.array([state == "yielding" for state in led.state])
    axes[2].fill_between(
        led.t, 0.0, 22.0, where=yielding, color="tab:green", alpha=0.25, label="the hand yields"
    )
    axes[2].axhline(10.0, color="0.4", ls=":", label="threshold")
    axes[2].set_ylabel("force [N]")
    axes[2].set_xlabel("time [s]      grey: elbow pushed, orange: hand pulled")
    axes[2].legend(loc="upper left")
    return picture


class Pressed(NamedTuple):
    """What a hand did that pressed on a table: a row for each control step."""

    t: np.ndarray
    force: np.ndarray
    """Of the table on the hand, shape (N, 3), N."""
    measured: np.ndarray
    """What the controller made of the sensor, along the table's normal, shape (N,), N."""
    place: np.ndarray
    """Of the hand, from where it began, shape (N, 3), m."""
    slide: tuple[float, float]
    """Begin and end of the sliding, s."""
    loop: DirectLoop


def press(
    hand: PressingHand = PANDA, duration: float = 7.5, slide: tuple[float, float] = (3.0, 6.0)
) -> Pressed:
    """Let a hand find a table, press on it and slide along it."""
    loop = DirectLoop(hand.robot, hand.changed)
    interaction = loop.controller.find(Interaction)
    start = loop.pose()
    x, y, z = start.translation
    table = (x, y, z - hand.reach - GAP - 0.05)
    loop.robot.obstacles.add(
        Obstacle("table", "box", (0.2, 0.6, 0.1), table, (0.0, 0.0, 0.0, 1.0))
    )
    end = pin.SE3(start.rotation, start.translation + SLIDE)
    way = PoseTrajectory(
        [
            TrajectoryPoint(0.0, start),
            TrajectoryPoint(slide[1] - slide[0], end),
        ]
    )
    rows = []

    def each(t: float) -> None:
        if abs(t - TARE) < 0.5 * loop.dt:
            interaction.sensor.tare()
        if abs(t - TARE - 0.1) < 0.5 * loop.dt:
            interaction.set_target(np.array([0.0, 0.0, hand.axis * FORCE, 0.0, 0.0, 0.0]))
        if t >= slide[0]:
            loop.controller.goals.set_pose(*way.sample(t - slide[0]))
        force = sum(
            (np.asarray(contact.force) for contact in loop.robot.obstacles.contacts()), np.zeros(3)
        )
        place = loop.pose().translation - start.translation
        rows.append((t, force, -hand.axis * interaction.sensor.wrench[2], place))

    loop.run(duration, each)
    t, force, measured, place = (np.array(column) for column in zip(*rows, strict=True))
    return Pressed(t, force, measured, place, slide, loop)


def judge_press(run: Pressed) -> dict[str, float]:
    """Return what a press amounts to."""
    normal = run.force[:, 2]
    touched = int(np.argmax(normal > 0.0))
    settled = run.t > run.t[touched] + 0.3
    sliding = (run.t >= run.slide[0]) & (run.t < run.slide[1])
    standing = settled & ~sliding
    window = round(0.05 / run.loop.dt)

    def steady(part: np.ndarray) -> float:
        """Return the largest error of a mean over 50 ms."""
        means = np.convolve(normal, np.ones(window) / window, mode="same")
        return float(np.abs(means[part][window:-window] - FORCE).max() / FORCE)

    return {
        "touched_s": float(run.t[touched]),
        "most_n": float(normal[touched:].max()),
        "least_after_contact_n": float(normal[settled].min()),
        "error_standing": steady(settled & (run.t < run.slide[0])),
        "error_sliding": steady(sliding),
        "error_standing_after": steady(standing & (run.t > run.slide[1] + 0.3)),
        "periods_without_contact": float((normal[touched + 1 :] <= 0.0).sum()),
        "slid_m": float(np.ptp(run.place[:, 1])),
        "limits_kept": float(within_limits(run.loop)),
    }


def _holds(numbers: Mapping[str, float]) -> bool:
    """Return whether a press keeps within 5% and does not bounce by 2 N."""
    return (
        max(numbers["error_standing"], numbers["error_sliding"]) < 0.05
        and numbers["most_n"] < FORCE + 2.0
        and numbers["least_after_contact_n"] > FORCE - 2.0
    )


def pressing(figure: Figure) -> None:
    """Hybrid control: 10 N on a table, sliding along it."""
    runs = {"Panda": press(PANDA), "TALOS": press(TALOS)}
    judged = {name: judge_press(run) for name, run in runs.items()}
    for name, run in runs.items():
        figure.metrics |= {f"{name.lower()}_{key}": v for key, v in judged[name].items()}
        figure.data |= {
            f"{name.lower()}_{key}": value
            for key, value in zip(("t", "force_n", "measured_n", "place_m"), run[:4], strict=True)
        }
    figure.rows = [
        (
            "Eq. (27)",
            "force control, not shown",
            f"{name}, {note}, presses with {FORCE:.0f} N: at most {numbers['most_n']:.1f} N; "
            f"within {100 * numbers['error_standing']:.1f} % standing, "
            f"{100 * numbers['error_sliding']:.1f} % sliding {100 * SLIDE[1]:.0f} cm",
            "within 5 %, 2 N" if _holds(numbers) else "not held: friction",
        )
        for (name, numbers), note in zip(
            judged.items(), ("without friction", "its friction compensated"), strict=True
        )
    ]
    figure.save(_draw_press(runs))


def _draw_press(runs: Mapping[str, Pressed]) -> plt.Figure:
    picture, axes = plt.subplots(
        3, 1, figsize=(9, 7), sharex=True, layout="constrained", height_ratios=(2, 2, 1)
    )
    for axis, (name, run) in zip(axes, runs.items(), strict=False):
        axis.plot(run.t, run.force[:, 2], label="table on hand, normal", lw=0.8)
        axis.plot(run.t, run.measured, label="as the controller sees it", lw=0.8)
        axis.plot(run.t, np.hypot(*run.force[:, :2].T), label="friction", lw=0.8)
        axis.axhline(FORCE, color="0.4", ls=":")
        axis.set_ylabel(f"{name}: force [N]")
        axis.set_ylim(-4.0, 25.0)
        axes[2].plot(run.t, 1e3 * run.place[:, 1], label=f"{name}, along the table")
    axes[0].legend(loc="upper left")
    axes[2].set_ylabel("hand [mm]")
    axes[2].set_xlabel("time [s]")
    axes[2].legend()
    return picture
