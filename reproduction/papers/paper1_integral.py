# SPDX-License-Identifier: Apache-2.0
"""Figures 3 and 5 of [Benallegue2021], and an endurance run.

bash scripts/reproduce.sh paper1-integral              all of it, and tables of docs/results.md
bash scripts/reproduce.sh paper1-integral fig5         one part

TALOS' torso and left arm, 9 joints at 1 kHz, with friction of 10% of the torque limits (stiction
13%), rotors, and links 10% heavier than the controller knows: `config/talos_left_arm.yaml`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from direct import DirectLoop, column, distance, hand_places
from figure import Figure, reproduce

from torque_safety_controller.parts.contact.interaction import Interaction

PART, ROBOT = "paper1-integral", "talos_left_arm"
ELBOW = 5
HAND = "wrist_left_ft_tool_link"
UNLIMIT, LASTING = "without anti-windup", "without leak"
"""Keys of no parameters: budgets are infinite, and one integrator forgets nothing."""
# Section IV-A: lambda = 2, tau_m = 0.1 of the torque limits, theta 0.1 and 100 1/s, mu = 0.5.
PAPER: dict[str, Any] = {"integral_lambda": 2.0, "integral_budget": []}
PRINTED = PAPER | {"integral_anti_windup": "paper"}
UNLIMITED = PRINTED | {UNLIMIT: True}
PLAIN = UNLIMITED | {LASTING: True}
# Pushes in world axes, N: to the side, and down.
PUSHES = ((0.0, -60.0, 0.0), (0.0, 0.0, -100.0))
PUSHED = ("overshoot", "recovery", "share", "share_pushed", "swing")
"""What `push` finds: m, s, budgets at most and when let go, N."""
AWAY = 0.01  # m
SENSOR_SETTLES = 0.1  # s


def make_loop(changed: dict[str, Any]) -> DirectLoop:
    """Return the arm with changed parameters, without anti-windup or leak where that is asked."""
    given = {name: value for name, value in changed.items() if name not in (UNLIMIT, LASTING)}
    loop = DirectLoop(ROBOT, given)
    if UNLIMIT in changed:
        loop.change_integral(budget=np.full(len(loop.config.joints), np.inf))
    if LASTING in changed:
        loop.change_integral(slow_leak_rate=0.0, mu=0.0)
    return loop


def goal(loop: DirectLoop, start: pin.SE3, offset: tuple[float, ...]) -> None:
    """Send the hand to a place near `start`, without turning it."""
    loop.controller.goals.set_pose(pin.SE3(start.rotation, start.translation + np.array(offset)))


def figure_3() -> Figure:
    """From position to torque control, with the elbow loaded by friction."""
    figure = Figure("paper1-fig3", PART)
    picture, axes = plt.subplots(1, 2, figsize=(14, 4.5), layout="constrained")
    cases = {"the file's values": {}, "the paper's values": PAPER}
    for axis, (name, changed) in zip(axes, cases.items(), strict=True):
        _handover(figure, axis, name, changed)
    figure.save(picture)
    return figure


def _handover(figure: Figure, axis: plt.Axes, name: str, changed: dict[str, Any]) -> None:
    """Add a handover to the figure."""
    loop = make_loop(changed)
    q = loop.config.start_positions.copy()
    for k in range(1500):  # move, so that friction holds a part of the weight, and rest
        q[ELBOW] = loop.config.start_positions[ELBOW] + 0.1 * min(1.0, k / 1000)
        loop.move(q)
    loop.resume(q)
    loop.run(1.5)
    samples = tuple(loop.samples[1000:])
    tau, additional = column(samples, "tau"), column(samples, "additional")
    t = column(samples, "t") - samples[501].t
    figure.data |= {f"{name}: t": t, f"{name}: tau": tau, f"{name}: additional": additional}
    jumps = np.abs(np.diff(tau, axis=0)) / loop.config.torque_max
    # Sample 500 is the drives' last, 501 the first under torque control.
    step, ordinary = float(jumps[500].max()), float(np.delete(jumps, 500, axis=0).max())
    without = float(np.abs(additional[501] / loop.config.torque_max).max())
    figure.metrics |= {
        f"{name}: handover_step_share": step,
        f"{name}: ordinary_step_share": ordinary,
        f"{name}: step_without_seed_share": without,
    }
    model = tau[501:, ELBOW] - additional[501:, ELBOW]
    axis.plot(t[501:], model, color="tab:purple", label="computed torque")
    axis.plot(t[501:], additional[501:, ELBOW], color="tab:blue", label="integral term")
    axis.plot(t, tau[:, ELBOW], color="black", label="torque of the motor")
    axis.axvline(0.0, color="tab:red", linestyle="--", label="handover")
    axis.set(xlabel="time [s]", ylabel="elbow torque [N m]", title=name)
    axis.legend()
    axis.grid(alpha=0.3)
    figure.add(
        "Fig. 3: handover at the elbow",
        "torque continuous",
        f"largest step {step:.3%} of tau_max, ordinary ones up to {ordinary:.3%}; it would have "
        f"been {without:.1%}",
        holds=step - ordinary < 0.01,
        so=f"so with {name}",
    )


def push(
    changed: dict[str, Any],
    force: tuple[float, ...],
    seconds: float = 5.0,
    before: float = 3.0,
    after: float = 4.0,
) -> dict:
    """Push the hand and let it go; return the loop, the samples, and what they amount to.

    Args:
        changed: parameters that differ from the file.
        force: N.
        seconds: that it is pushed for.
        before: how long it moves to its goal first, s.
        after: how long it is watched when it is released, s.
    """
    loop = make_loop(changed)
    interaction = loop.controller.find(Interaction)
    start = loop.pose()
    loop.run(0.1)
    interaction.sensor.tare()
    loop.run(0.4)
    goal(loop, start, (0.05, 0.05, 0.1))
    loop.run(before)
    target = loop.controller.goals.pose_des.translation
    along = np.array(force) / np.linalg.norm(force)
    felt = []

    def feel(_: float) -> None:
        felt.append(along @ loop.controller.robot.pose.rotation @ interaction.sensor.wrench[:3])

    loop.robot.apply_wrench(HAND, force, (0.0, 0.0, 0.0))
    pushed = loop.run(seconds, feel)
    loop.robot.clear_wrenches()
    released = loop.run(after, feel)
    places = hand_places(loop, released) - target
    direction = places[0] / np.linalg.norm(places[0])
    far = np.flatnonzero(np.linalg.norm(places, axis=1) > AWAY)
    share = np.abs(column(pushed + released, "additional")) / loop.integral_budget
    let_go, settled = len(pushed), round(SENSOR_SETTLES / loop.dt)
    return {
        "loop": loop,
        "samples": pushed + released,
        "felt": np.array(felt),
        "overshoot": max(0.0, float(-(places @ direction).min())),
        "recovery": float((far[-1] + 1) * loop.dt) if far.size else 0.0,
        "share": float(share.max()),
        "share_pushed": float(share[let_go - settled : let_go].max()),
        "swing": float(np.ptp(felt[let_go + settled :])),
    }


OFFSETS = ((0.05, 0.1, 0.15), (0.1, -0.1, -0.05), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0))


def track(changed: dict[str, Any], seconds: float = 8.0) -> tuple[float, float]:
    """Send the hand to several places; return the mean distance while there, and all the way."""
    loop = make_loop(changed)
    start = loop.pose()
    rest, way = [], []
    for offset in OFFSETS:
        goal(loop, start, offset)
        far = distance(loop.run(seconds))
        rest.append(far[-round(2.0 / loop.dt) :].mean())
        way.append(np.sqrt((far[round(1.0 / loop.dt) :] ** 2).mean()))
    return float(np.mean(rest)), float(np.mean(way))


BARE, AS_PRINTED = "leaky, no anti-windup", "leaky, (11) as printed"
WHOLE, FILES = "leaky, (11), whole torque", "the same, the file's values"
LAWS = {
    "no integral": {"integral_action": "none"},
    "plain integral": PLAIN,
    BARE: UNLIMITED,
    "leaky, (10)": PAPER | {"integral_anti_windup": "scaling"},
    AS_PRINTED: PRINTED,
    WHOLE: PAPER,
    FILES: {},
    "and friction compensation": {"friction_compensation": 1.0},
}
"""With the paper's values but for the last two; (12) to (14) leak."""
LAW_HEADS = (
    "Fig. 5: integral action",
    "error at rest, mm",
    "on the way, mm",
    "peak torque, budgets",
    "overshoot, mm",
    "within 1 cm after, s",
    "",
)


def figure_5() -> Figure:
    """Errors of the hand, and what comes of a push and its release, by integral action."""
    figure = Figure("paper1-fig5", PART, LAW_HEADS)
    found, errors = {}, {}
    for name, changed in LAWS.items():
        errors[name] = track(changed)
        found[name] = [push(changed, force) for force in PUSHES]
    for name, runs in found.items():
        worst = {key: max(run[key] for run in runs) for key in PUSHED}
        rest, way = errors[name]
        figure.metrics |= {f"{name}: {key}": value for key, value in worst.items()}
        figure.rows.append(
            (
                name,
                f"{1e3 * rest:.2f}",
                f"{1e3 * way:.2f}",
                f"{worst['share']:.2f}",
                f"{1e3 * worst['overshoot']:.1f}",
                f"{worst['recovery']:.2f}",
                _verdict(name, found),
            )
        )
    picture, axes = plt.subplots(1, 2, figsize=(10, 3.7), layout="constrained")
    for name, color in ((BARE, "tab:red"), (WHOLE, "tab:green")):
        run = found[name][1]
        t, additional = (column(run["samples"], key) for key in ("t", "additional"))
        share = additional[:, ELBOW] / run["loop"].integral_budget[ELBOW]
        figure.data[name] = np.column_stack([t - t[0], share, distance(run["samples"])])
        axes[0].plot(t - t[0], share, color=color, label=name)
        axes[1].plot(t - t[0], 1e3 * distance(run["samples"]), color=color, label=name)
    axes[0].axhspan(-1.0, 1.0, color="tab:gray", alpha=0.15, lw=0, label="the budget")
    axes[0].set(ylabel="integral torque of the elbow, in budgets")
    axes[1].set(ylabel="hand off its goal, mm")
    for axis in axes:
        axis.axvline(5.0, color="k", ls="--", lw=1)
        axis.set(xlabel="time, s; let go at 5 s", xlim=(0.0, 9.0))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=9)
    figure.save(picture, "integral_action")
    return figure


def _verdict(name: str, found: dict[str, list[dict]]) -> str:
    """Return whether a law does as in the paper at each push; empty if the paper has none such."""
    holds = []
    for k, run in enumerate(found[name]):
        bare, printed = found[BARE][k], found[AS_PRINTED][k]
        if name == BARE:  # grows, and the hand swings more at the release
            worse = all(run[each] > printed[each] for each in ("overshoot", "swing"))
            holds.append(run["share_pushed"] > 2.0 and worse)
        elif name in (AS_PRINTED, WHOLE, FILES):
            # Saturates; C s of an arm that still moves may be in it, too.
            saturated = run["share_pushed"] <= 1.2 and run["overshoot"] <= bare["overshoot"] / 3.0
            holds.append(saturated and (run is not printed or run["share"] > 1.2))
    return "" if not holds else "so" if all(holds) else "not so"


class Disturbed:
    """An arm that is pushed, sent about and retuned at random; counts what it does.

    Args:
        changed: parameters that differ from the file's.
    """

    LINKS = ("arm_left_2_link", "arm_left_4_link", "arm_left_7_link", HAND)

    def __init__(self, changed: dict[str, Any]) -> None:
        self.loop = DirectLoop(ROBOT, changed)
        self._start = self.loop.pose()
        self._rng = np.random.default_rng(7)
        self._until = 0.0
        self.steps = self.not_finite = self.beyond = self.beyond_pushed = 0
        self.torque_ratio = self.deepest = self.fastest = 0.0

    def run(self, minutes: float) -> None:
        """Play on, with something new every half second."""
        for _ in range(round(60.0 * minutes / 0.5)):
            self._happen()
            for _ in range(round(0.5 / self.loop.dt)):
                self._step()

    def _happen(self) -> None:
        rng, loop = self._rng, self.loop
        kind = rng.integers(4)
        if kind == 0:
            goal(loop, self._start, tuple(rng.uniform(-0.3, 0.3, 3)))
        elif kind == 1 and loop.t > self._until:
            force = rng.normal(size=3)
            force *= rng.uniform(10.0, 150.0) / np.linalg.norm(force)
            loop.robot.apply_wrench(str(rng.choice(self.LINKS)), force, (0.0, 0.0, 0.0))
            self._until = loop.t + rng.uniform(0.1, 5.0)
        elif kind == 2:
            loop.change(
                integral_lambda=float(rng.choice([2.0, 10.0, 100.0])),
                integral_budget=(rng.uniform(0.05, 0.3) * loop.config.torque_max).tolist(),
            )

    def _step(self) -> None:
        loop = self.loop
        if loop.t > self._until:
            loop.robot.clear_wrenches()
        step = loop.step()
        sample = loop.samples.pop()
        self.steps += 1
        self.not_finite += not np.isfinite(step.tau).all()
        ratio = (np.abs(step.tau) / loop.config.torque_max).max()
        self.torque_ratio = max(self.torque_ratio, float(ratio))
        over = np.maximum(
            sample.q - loop.config.position_max, loop.config.position_min - sample.q
        ).max()
        fast = (np.abs(sample.v) - loop.config.velocity_max).max()
        self.deepest, self.fastest = max(self.deepest, over), max(self.fastest, fast)
        if over > 0.0 or fast > 0.0:
            self.beyond += 1
            self.beyond_pushed += loop.t <= self._until

    def told(self) -> str:
        """Return what came out, in a sentence."""
        return (
            f"torque at most {self.torque_ratio:.4f} of its limits; joint limits passed in "
            f"{self.beyond} of {self.steps} steps, by up to {1e3 * self.deepest:.1f} mrad"
        )


def endurance(minutes: float = 10.0) -> Figure:
    """Random pushes, goals and parameter changes: what stays within its limits."""
    figure = Figure("paper1-endurance", PART)
    cases = (
        (f"{minutes:g} minutes of random pushes up to 150 N, goals and parameters", {}, minutes),
        ("1 minute of it with disturbance_time 0", {"disturbance_time": 0.0}, 1.0),
    )
    for name, changed, duration in cases:
        run = Disturbed(changed)
        run.run(duration)
        for key in ("torque_ratio", "deepest", "fastest"):
            figure.metrics[f"{name}: {key}"] = float(getattr(run, key))
        kept = run.torque_ratio <= 1.0 and not run.not_finite
        # Limits may be passed where a push is more than the motors can hold.
        kept &= bool(changed) or run.beyond == run.beyond_pushed
        figure.add(
            name,
            "-" if changed else "torque limits kept whatever the integral does",
            run.told(),
            holds=kept,
            so="for comparison" if changed else "kept, the file's values",
        )
    figure.save()
    return figure


PARTS: dict[str, Callable[[], Figure]] = {
    "fig3": figure_3,
    "endurance": endurance,
    "fig5": figure_5,
}

if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, PARTS))
