# SPDX-License-Identifier: Apache-2.0
"""Figure 9 of [Benallegue2021], dual compliance; and pressing on a table, sliding along it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from compliance_push import ELBOW, HAND, HEADS, PART, RAMP, ROBOT, WITH_FILE
from direct import DirectLoop, within_limits
from figure import Figure

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
    """A hand that points down, to press with.

    Attributes:
        robot: name of its file.
        changed: parameters that differ from the file's.
        axis: 1 or -1: the fingers point along the end effector's z axis, or against it.
        reach: of the fingertips from the end effector's frame, m.
    """

    robot: str
    changed: dict[str, Any]
    axis: float
    reach: float


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
SLIDE = np.array([0.0, 0.15, 0.0])  # m


class Led(NamedTuple):
    """What a hand did that was pulled and let go: a row for each control step.

    Attributes:
        t: time, s.
        place, turn: of the hand from where it began, m, shape (N, 3), and rad.
        joints: shape (N, n), rad.
        force: measured at the hand, N.
        state: of the controller's interaction.
        loop: that was played.
    """

    t: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    joints: np.ndarray
    force: np.ndarray
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


def figure_9() -> Figure:
    """Dual compliance: elbow pushed, hand pulled, let go, and the elbow pushed once more."""
    figure = Figure("paper1-fig9", PART, HEADS)
    pushes = [
        (1.0, 3.0, ELBOW, ELBOW_PUSH),
        (4.0, 6.0, HAND, PULL),
        (7.5, 9.5, ELBOW, -ELBOW_PUSH),
    ]
    led = lead(pushes, 10.5)
    pulled, released = led.at(4.0), led.at(6.0)
    stayed = float(np.linalg.norm(led.place[:pulled], axis=1).max())
    turned = float(led.turn[:pulled].max())
    moved = float(np.linalg.norm(led.place[released] - led.place[pulled]))
    kept = np.linalg.norm(led.place[released:] - led.place[released], axis=1)
    null = float(np.abs(led.joints[led.at(1.0) : led.at(3.0)] - led.joints[led.at(1.0)]).max())
    calm = all(s != "yielding" for t, s in zip(led.t, led.state, strict=True) if not 4 <= t < 6.1)
    figure.data = dict(zip(Led._fields[:5], led[:5], strict=True))
    figure.metrics = {
        "hand_while_elbow_pushed_m": stayed,
        "joint_moved_by_elbow_push_rad": null,
        "hand_led_m": moved,
        "kept_after_release_m": float(kept.max()),
    }
    figure.add(
        "Fig. 9",
        "the hand stays when the arm is pushed",
        "",
        f"elbow pushed with {np.linalg.norm(ELBOW_PUSH):.0f} N: hand within {1e3 * stayed:.1f} "
        f"mm, a joint moves by {null:.2f} rad",
        holds=stayed < 0.005 and turned < np.radians(1.0) and null > 0.1 and calm,
        so=WITH_FILE,
    )
    figure.add(
        "Fig. 9",
        "moved freely when the hand itself is; its new place is kept",
        "",
        f"{PULL[0]:.0f} N move it by {1e3 * moved:.0f} mm in 2 s; kept within "
        f"{1e3 * kept[: led.at(7.5) - released].max():.1f} mm when let go, "
        f"{1e3 * kept.max():.1f} mm when the elbow is pushed again",
        holds=moved > 0.02 and kept.max() < 0.005 and within_limits(led.loop),
        so=WITH_FILE,
    )
    figure.save(_draw_dual(led, pushes))
    return figure


def _draw_dual(led: Led, pushes: list[tuple[float, float, str, np.ndarray]]) -> plt.Figure:
    picture, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    axes[0].plot(led.t, 1e3 * led.place, label=list("xyz"))
    axes[0].set_ylabel("hand, from its start [mm]")
    moved = led.joints - led.joints[0]
    for joint in np.abs(moved).max(axis=0).argsort()[-3:]:
        axes[1].plot(led.t, moved[:, joint], label=led.loop.config.joints[joint])
    axes[1].set_ylabel("joints that move most [rad]")
    axes[2].plot(led.t, led.force, label="measured at the hand", lw=0.8)
    axes[2].axhline(10.0, color="0.4", ls=":", label="threshold")
    axes[2].set_ylabel("force [N]")
    axes[2].set_xlabel("time [s]; grey: elbow pushed, orange: hand pulled")
    for axis in axes:
        axis.legend(loc="upper left")
        for begin, end, link, _ in pushes:
            color = "tab:orange" if link == HAND else "0.85"
            axis.axvspan(begin, end, color=color, alpha=0.4, lw=0)
    return picture


class Pressed(NamedTuple):
    """What a hand did that pressed on a table: a row for each control step.

    Attributes:
        t: time, s.
        force: of the table on the hand, shape (N, 3), N.
        slide: begin and end of the sliding, s.
        loop: that was played.
    """

    t: np.ndarray
    force: np.ndarray
    slide: tuple[float, float]
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
    way = PoseTrajectory([TrajectoryPoint(0.0, start), TrajectoryPoint(slide[1] - slide[0], end)])
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
        rows.append((t, force))

    loop.run(duration, each)
    t, force = (np.array(column) for column in zip(*rows, strict=True))
    return Pressed(t, force, slide, loop)


def judge_press(run: Pressed) -> dict[str, float]:
    """Return what a press amounts to."""
    normal = run.force[:, 2]
    touched = int(np.argmax(normal > 0.0))
    settled = run.t > run.t[touched] + 0.3
    sliding = (run.t >= run.slide[0]) & (run.t < run.slide[1])
    window = round(0.05 / run.loop.dt)

    def steady(part: np.ndarray) -> float:
        """Return the largest error of a mean over 50 ms."""
        means = np.convolve(normal, np.ones(window) / window, mode="same")
        return float(np.abs(means[part][window:-window] - FORCE).max() / FORCE)

    return {
        "most_n": float(normal[touched:].max()),
        "least_after_contact_n": float(normal[settled].min()),
        "error_standing": steady(settled & (run.t < run.slide[0])),
        "error_sliding": steady(sliding),
        "limits_kept": float(within_limits(run.loop)),
    }


def pressing() -> Figure:
    """Hybrid control: 10 N on a table, sliding along it."""
    figure = Figure("paper1-press", PART, HEADS)
    runs = {
        "Panda, without friction": press(PANDA),
        "TALOS, its friction compensated": press(TALOS),
    }
    for name, run in runs.items():
        numbers = judge_press(run)
        figure.metrics |= {f"{name}: {key}": value for key, value in numbers.items()}
        figure.data[f"{name}: force_n"] = run.force
        standing, sliding = numbers["error_standing"], numbers["error_sliding"]
        holds = max(standing, sliding) < 0.05
        holds &= numbers["most_n"] < FORCE + 2.0 and numbers["least_after_contact_n"] > FORCE - 2.0
        figure.rows.append(
            (
                f"Eq. (27), force control. {name}",
                "not shown",
                "",
                f"presses with {FORCE:.0f} N: at most {numbers['most_n']:.1f} N; within "
                f"{100 * standing:.1f} % standing, {100 * sliding:.1f} % sliding "
                f"{100 * SLIDE[1]:.0f} cm",
                "within 5 %, 2 N" if holds else "not held: friction",
            )
        )
    figure.save()
    return figure
