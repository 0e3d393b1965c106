# SPDX-License-Identifier: Apache-2.0
"""One integral for two hands at once: (15) to (26) of [Benallegue2021] with 12 rows.

bash scripts/reproduce.sh two-hands

TALOS' torso and both arms, 16 joints at 1 kHz, with friction of 10% of the torque limits (stiction
13%), rotors, and links 10% heavier than the controller knows:
`config/two_hands/talos_arms.yaml`.
"""

from __future__ import annotations

from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from direct import DirectLoop, column, within_limits
from figure import Figure, reproduce, table, verdict

ROBOT = "two_hands/talos_arms"
HANDS = {"left": "wrist_left_ft_tool_link", "right": "wrist_right_ft_tool_link"}
ELBOW = "arm_left_4_link"  # its origin is the elbow
MODES = {"without": "joints", "with": "task"}
RAMP = 0.3  # s, in which a push grows
HAND_FORCE, ELBOW_FORCE = 50.0, 120.0  # N
HELD, PAUSE = 2.0, 0.5  # s


class Push(NamedTuple):
    """A force on a link for `HELD` seconds."""

    name: str
    link: str
    force: np.ndarray
    """Shape (3,), N, in the root link's axes."""
    begin: float
    """s."""


def weakest_direction(loop: DirectLoop, link: str) -> tuple[np.ndarray, float]:
    """Return in which direction a link gives way to the least force, shape (3,), and that, N.

    While both hands stay: as `compliance_push.weakest_direction`, in the null space of 12 rows.
    """
    data, model = loop.model.createData(), loop.model
    pin.computeJointJacobians(model, data, loop.robot.state().q)
    pin.updateFramePlacements(model, data)
    axes = pin.LOCAL_WORLD_ALIGNED
    hands = [pin.getFrameJacobian(model, data, model.getFrameId(f), axes) for f in HANDS.values()]
    J_link = pin.getFrameJacobian(model, data, model.getFrameId(link), axes)[:3]
    null = np.linalg.svd(np.vstack(hands))[2][12:].T
    directions = null @ np.random.default_rng(0).normal(size=(null.shape[1], 100_000))
    stiction = np.array(loop.config.friction_static)
    motion = J_link @ directions / (np.abs(directions).T @ stiction)
    sizes = np.linalg.norm(motion, axis=0)
    best = sizes.argmax()
    return motion[:, best] / sizes[best], 1.0 / float(sizes[best])


class Run(NamedTuple):
    """What pushes did.

    Attributes:
        errors: of both hands, shape (N, 2), m.
        turns: likewise, rad.
        q: positions, shape (N, n), rad.
        budgets: additional torque in budgets, shape (N, n).
        kept: whether all limits were kept.
        loop: the robot and its controller.
    """

    errors: np.ndarray
    turns: np.ndarray
    q: np.ndarray
    budgets: np.ndarray
    kept: bool
    loop: DirectLoop


def play(mode: str, pushes: tuple[Push, ...]) -> Run:
    """Push a robot that holds both hands where they are."""
    loop = DirectLoop(ROBOT, {"integral_action": mode})
    controller, errors, turns = loop.controller, [], []
    loop.run(0.5)
    goals = controller.goals.pose_des, *controller.goals.others
    begin = loop.t

    def each(t: float) -> None:
        poses = [loop.pose(frame) for frame in HANDS.values()]
        pairs = list(zip(poses, goals, strict=True))
        errors.append([np.linalg.norm(p.translation - g.translation) for p, g in pairs])
        turns.append([np.linalg.norm(pin.log3(p.rotation.T @ g.rotation)) for p, g in pairs])
        loop.robot.clear_wrenches()
        for push in pushes:
            if push.begin <= t - begin < push.begin + HELD:
                share = min(1.0, (t - begin - push.begin) / RAMP)
                loop.robot.apply_wrench(push.link, share * push.force, np.zeros(3))

    samples = loop.run(pushes[-1].begin + HELD + PAUSE, each)
    budget = controller.additional.settings.integral.budget
    return Run(
        np.array(errors),
        np.array(turns),
        column(samples, "q"),
        np.abs(column(samples, "additional")) / budget,
        within_limits(loop),
        loop,
    )


def course(direction: np.ndarray) -> tuple[Push, ...]:
    """Return pushes on the left elbow, there and back, and on the left hand along each axis."""
    forces = [("elbow", ELBOW, ELBOW_FORCE * direction), ("back", ELBOW, -ELBOW_FORCE * direction)]
    for axis, unit in zip("xyz", np.eye(3), strict=True):
        forces += [(f"{sign}{axis}", HANDS["left"], float(f"{sign}1") * HAND_FORCE * unit)
                   for sign in "+-"]  # fmt: skip
    return tuple(
        Push(name, link, force, k * (HELD + PAUSE)) for k, (name, link, force) in enumerate(forces)
    )


def pushes() -> Figure:
    """The left elbow pushed, then the left hand: what both hands and the null space do."""
    figure = Figure("two-hands-pushes")
    direction, least = weakest_direction(DirectLoop(ROBOT), ELBOW)
    plan = course(direction)
    dt = 1e-3
    split = round(plan[2].begin / dt)  # elbow, then hand
    picture, axes = plt.subplots(2, 2, figsize=(12, 7), sharex=True, layout="constrained")
    found = {}
    for (name, mode), (upper, lower) in zip(MODES.items(), axes.T, strict=True):
        run = play(mode, plan)
        moved = np.abs(run.q[:split] - run.q[0]).max(axis=0)
        steady = [
            run.errors[round((p.begin + HELD - 0.3) / dt) : round((p.begin + HELD) / dt)].mean(0)
            for p in plan[2:]
        ]
        found[name] = {
            "witness_motion_rad": float(moved.max()),
            "elbow_left_m": float(run.errors[:split, 0].max()),
            "elbow_right_m": float(run.errors[:split, 1].max()),
            "elbow_turn_rad": float(run.turns[:split].max()),
            "hand_left_m": float(run.errors[split:, 0].max()),
            "hand_right_m": float(run.errors[split:, 1].max()),
            "hand_left_steady_m": float(np.mean([each[0] for each in steady])),
            "most_budgets": float(run.budgets.max()),
            "limits_kept": float(run.kept),
        }
        figure.metrics |= {f"{name}: {key}": value for key, value in found[name].items()}
        t = dt * np.arange(len(run.q))
        figure.data |= {f"{name}: q": run.q, f"{name}: errors": run.errors}
        upper.plot(t, 1e3 * run.errors, label=[f"{hand} hand" for hand in HANDS])
        upper.set(title=f"{name} null-space compliance", ylabel="off its goal [mm]")
        witness = int(moved.argmax())
        lower.plot(t, run.q - run.q[0], color="gray", lw=0.7)
        joint = run.loop.config.joints[witness]
        lower.plot(t, run.q[:, witness] - run.q[0, witness], "k", lw=2, label=joint)
        lower.set(xlabel="time [s]", ylabel="joints move [rad]")
        for axis in (upper, lower):
            axis.grid(alpha=0.3)
            axis.legend(fontsize="small")
            for push in plan:
                color = "orange" if push.link == ELBOW else "gray"
                axis.axvspan(push.begin, push.begin + HELD, color=color, alpha=0.15)
    for row in axes:
        low, high = min(a.get_ylim()[0] for a in row), max(a.get_ylim()[1] for a in row)
        for axis in row:
            axis.set_ylim(low, high)
    figure.metrics["stiction_elbow_n"] = least
    without, with_it = found.values()
    kept = all(each["limits_kept"] == 1.0 and each["most_budgets"] <= 1.0 + 1e-9
               for each in found.values())  # fmt: skip
    ratio = with_it["witness_motion_rad"] / without["witness_motion_rad"]
    both = max(with_it["elbow_left_m"], with_it["elbow_right_m"])
    figure.rows += [
        (
            f"left elbow pushed with {ELBOW_FORCE:.0f} N for {HELD:.0f} s, there and back "
            f"(stiction alone holds {least:.0f} N): a null-space joint moves",
            *(f"{each['witness_motion_rad']:.3f} rad" for each in found.values()),
            verdict(ratio >= 3.0, f"{ratio:.0f} times further"),
        ),
        (
            "left / right hand meanwhile, at most",
            *(
                f"{1e3 * each['elbow_left_m']:.1f} / {1e3 * each['elbow_right_m']:.1f} mm, "
                f"{np.degrees(each['elbow_turn_rad']):.2f}°"
                for each in found.values()
            ),
            verdict(both <= 5e-3, "both stay"),
        ),
        (
            f"left hand pushed with {HAND_FORCE:.0f} N along x, y, z, both ways: left hand, mean "
            "of the last 0.3 s of all six; at most, left / right",
            *(
                f"{1e3 * each['hand_left_steady_m']:.2f} mm; {1e3 * each['hand_left_m']:.1f} / "
                f"{1e3 * each['hand_right_m']:.1f} mm"
                for each in found.values()
            ),
            verdict(
                with_it["hand_left_steady_m"] <= 1.2 * without["hand_left_steady_m"],
                "stiffness not lower",
            ),
        ),
        (
            "additional torque at most, in budgets; limits of position, speed and torque",
            *(
                f"{each['most_budgets']:.2f}; {'kept' if each['limits_kept'] else 'passed'}"
                for each in found.values()
            ),
            verdict(kept, "kept"),
        ),
    ]
    figure.save(picture)
    return figure


HEADS = "", "`integral_action: joints`", "`integral_action: task`", ""


if __name__ == "__main__":
    parts = {"pushes": pushes}
    raise SystemExit(
        reproduce(__doc__, parts, lambda _: None, lambda figures: table(figures, HEADS))
    )
