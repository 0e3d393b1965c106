# SPDX-License-Identifier: Apache-2.0
"""Figures 6 to 11 of [Benallegue2021] with the paper's own values, on arms of less friction, too.

The paper has lambda = 2 1/s, a budget of 10% of the torque limits (IV-A) and an admittance gain
of 5e-3 m/s^2 per N (Table I); `config/talos_left_arm.yaml` has 100 1/s, 20%, and the hand yields
with 0.1. Stiction is 13% of the torque limits in the file: more than the paper's budget.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from chain import ROOT
from compliance_curve import POLES, draw
from compliance_curve import judge as judge_curve
from compliance_hand import PULL, lead
from compliance_push import ELBOW, HAND, HAND_FORCE, MODES, ROBOT, judge, push, weakest_direction
from direct import DirectLoop
from figure import Figure
from paper1_integral import PAPER

from viability_bounds_pkg.parameter_files import read_yaml

ADMITTANCE = 5e-3  # m/s^2 per N, rad/s^2 per N m; Table I
PUSH, HARD_PUSH = 0.9, 1.3
"""Pushes on the elbow, in what stiction alone holds: 100 and 144 N on the file's arm."""
STICTION = 13.0  # of the torque limits in the file, %
COMPLIANT = MODES["with null-space compliance"]


def arm(friction: float, rotors: float = 1.0) -> dict[str, Any]:
    """Return the parameters of an arm with other friction and rotors, in parts of the file's.

    The model of the friction that the controller has follows; it is compensated nowhere here.
    """
    file = read_yaml(ROOT / "config" / f"{ROBOT}.yaml")
    kinds = ("coulomb", "static", "viscous")
    scales = {"/**": {"rotor_inertia": rotors}}
    for node, name in (("bullet_node", "friction"), ("controller_node", "friction_model")):
        scales[f"/**/{node}"] = {f"{name}_{kind}": friction for kind in kinds}
    return {
        name: [scale * value for value in file[section]["ros__parameters"][name]]
        for section, names in scales.items()
        for name, scale in names.items()
    }


class Case(NamedTuple):
    """Values of the controller, and the arm that they are tried on.

    Attributes:
        changed: parameters that differ from the file's.
        admittance: with which the hand yields, m/s^2 per N; None for the file's.
    """

    changed: dict[str, Any]
    admittance: float | None = ADMITTANCE


CASES = {
    "the paper's values": Case(PAPER),
    "half the friction": Case(PAPER | arm(0.5)),
    "half the friction, λ = 10 1/s": Case(PAPER | arm(0.5) | {"integral_lambda": 10.0}),
    "the file's values": Case({}, None),
}


def measure(case: Case) -> dict[str, float]:
    """Play the pushes of figures 6 to 9 and the curves of figures 10 and 11."""
    direction, holds = weakest_direction(DirectLoop(ROBOT, case.changed), ELBOW)
    found = {"elbow_n": PUSH * holds}
    for key, changed in zip(("without", "with"), MODES.values(), strict=True):
        run = judge(push(case.changed | changed, elbow=PUSH * holds))
        found |= {f"{key}_{name}": value for name, value in run.items()}
    pushes = [(1.0, 3.0, ELBOW, PUSH * holds * direction), (4.0, 6.0, HAND, PULL)]
    led = lead(pushes, 7.5, changed=case.changed, admittance=case.admittance)
    pulled, released = led.at(4.0), led.at(6.0)
    moved = np.abs(led.joints - led.joints[led.at(1.0)])[led.at(1.0) : led.at(3.0)]
    found |= {
        "dual_hand_m": float(np.linalg.norm(led.place[:pulled], axis=1).max()),
        "dual_joint_rad": float(moved.max()),
        "led_m": float(np.linalg.norm(led.place[released] - led.place[pulled])),
    }
    found["poles_m"] = judge_curve(draw(case.changed | COMPLIANT, POLES, turns=1))["hand_m"]
    return found


Found = Mapping[str, float]
STATEMENTS: tuple[tuple[str, str, str, Callable[[Found], bool] | None], ...] = (
    (
        "Fig. 6 to 8: elbow pushed, a joint moves without / with",
        "hardly / much easier (no number)",
        "{elbow_n:.0f} N: {without_witness_motion_rad:.3f} / {with_witness_motion_rad:.3f} rad",
        lambda found: (
            found["with_witness_motion_rad"] >= 3.0 * found["without_witness_motion_rad"]
        ),
    ),
    (
        "the hand meanwhile, without / with",
        "stiff / still stiff (no number)",
        "{without_elbow_hand_mm:.1f} / {with_elbow_hand_mm:.1f} mm, "
        "{without_elbow_hand_deg:.1f} / {with_elbow_hand_deg:.1f}°",
        None,
    ),
    (
        f"Fig. 6: hand pushed with {HAND_FORCE:.0f} N, its error without / with",
        "stiff / also stiff (no number)",
        "{without_steady_mm:.2f} / {with_steady_mm:.2f} mm",
        lambda found: found["with_steady_m"] <= 1.1 * found["without_steady_m"],
    ),
    (
        "Fig. 9: elbow pushed for 2 s, joint and hand",
        "the hand stays where it is (no number)",
        "{dual_joint_rad:.3f} rad, {dual_hand_mm:.1f} mm",
        None,
    ),
    (
        f"Fig. 9: hand led with {PULL[0]:.0f} N for 2 s",
        "moved freely (no number)",
        "{led_mm:.1f} mm",
        lambda found: found["led_m"] >= 0.02,
    ),
    (
        "Fig. 10, 11: a turn of 40 cm in 8 s among two poles",
        "under 20 mm",
        "{poles_mm:.1f} mm",
        lambda found: found["poles_m"] < 0.02,
    ),
)
"""What, the paper, what is told of a case, and when it is so."""


def own_values() -> Figure:
    """All statements of figures 6 to 11, by values and arm."""
    name = "paper1-values"
    figure = Figure(name, name, ("figure", "the paper", *CASES))
    found = {case_name: measure(case) for case_name, case in CASES.items()}
    for case_name, each in found.items():
        figure.metrics |= {f"{case_name}: {key}": value for key, value in each.items()}
    for what, paper, told, holds in STATEMENTS:
        cells = []
        for each in found.values():
            units = {f"{key[:-2]}_mm": 1e3 * x for key, x in each.items() if key.endswith("_m")}
            units |= {
                f"{key[:-4]}_deg": np.degrees(x) for key, x in each.items() if key.endswith("_rad")
            }
            judged = "" if holds is None else f": **{'so' if holds(each) else 'not so'}**"
            cells.append(told.format(**each, **units) + judged)
        figure.rows.append((what, paper, *cells))
    figure.save()
    return figure


FRICTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the file's
ARMS = ((2.0, 1.0), (10.0, 1.0), (100.0, 1.0), (2.0, 4.0))
"""lambda, 1/s; rotors, in parts of the file's."""


def stiction() -> Figure:
    """The elbow pushed, by friction, rotors and lambda, with the paper's budget of 10%."""
    figure = Figure("paper1-stiction")
    picture, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    shares = STICTION * np.array(FRICTIONS)
    for gain, rotors in ARMS:
        rows = np.array([_pushed(friction, rotors, gain) for friction in FRICTIONS])
        name = f"λ = {gain:g} 1/s" + (", 4 times the rotors" if rotors != 1.0 else "")
        figure.data[name] = np.column_stack([shares, rows])
        without, with_it, hand_without, hand = rows.T
        axes[0].plot(shares, with_it / without, "o-", label=name)
        (line,) = axes[1].plot(shares, 1e3 * hand, "o-", label=f"{name}, with")
        axes[1].plot(shares, 1e3 * hand_without, "o:", color=line.get_color(), mfc="none")
    axes[0].set(ylabel="null-space joint moves further with, times", yscale="log")
    axes[1].set(ylabel="hand off its goal, at most [mm]; dotted: without", yscale="log")
    for axis in axes:
        axis.set_xlabel("stiction [% of the torque limits]")
        axis.axvline(10.0, color="black", linestyle="--", lw=1)
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small", title="dashed: the budget")
    figure.save(picture, "stiction")
    return figure


def _pushed(friction: float, rotors: float, gain: float) -> tuple[float, ...]:
    """Return how far a joint moved without and with, rad, and the hand's errors, m."""
    changed = PAPER | arm(friction, rotors) | {"integral_lambda": gain}
    _, holds = weakest_direction(DirectLoop(ROBOT, changed), ELBOW)
    runs = [
        judge(push(changed | mode, hand=0.0, elbow=HARD_PUSH * holds)) for mode in MODES.values()
    ]
    return tuple(run[key] for key in ("witness_motion_rad", "elbow_hand_m") for run in runs)
