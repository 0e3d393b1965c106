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
from figure import Figure, table

from viability_bounds_pkg.parameter_files import read_yaml

VALUES_NAME, STICTION_NAME = "paper1-values", "paper1-stiction"
PAPER: dict[str, Any] = {"integral_lambda": 2.0, "integral_budget": []}
"""Section IV-A: lambda, and tau_m = 0.1 of the torque limits."""
ADMITTANCE = 5e-3  # m/s^2 per N, rad/s^2 per N m; Table I
PUSH, HARD_PUSH = 0.9, 1.3
"""Pushes on the elbow, in what stiction alone holds: 100 and 144 N on the file's arm."""
STICTION = 13.0  # of the torque limits in the file, %
COMPLIANT = MODES["with null-space compliance"]


def arm(friction: float = 1.0, rotors: float = 1.0) -> dict[str, Any]:
    """Return the parameters of an arm with other friction and rotors, in parts of the file's.

    The model of the friction that the controller has follows; it is compensated nowhere here.
    """
    file = read_yaml(ROOT / "config" / f"{ROBOT}.yaml")
    scales = {
        "/**": {"rotor_inertia": rotors},
        "/**/bullet_node": dict.fromkeys(
            ("friction_coulomb", "friction_static", "friction_viscous"), friction
        ),
        "/**/controller_node": dict.fromkeys(
            ("friction_model_coulomb", "friction_model_static", "friction_model_viscous"), friction
        ),
    }
    return {
        name: [scale * value for value in file[section]["ros__parameters"][name]]
        for section, names in scales.items()
        for name, scale in names.items()
    }


class Case(NamedTuple):
    """Values of the controller, and the arm that they are tried on."""

    name: str
    changed: dict[str, Any]
    """Parameters that differ from the file's."""
    admittance: float | None = None
    """With which the hand yields, m/s^2 per N; None for the file's."""


CASES = (
    Case("the paper's values", PAPER, ADMITTANCE),
    Case("half the friction", PAPER | arm(0.5), ADMITTANCE),
    Case(
        "half the friction, 4 times the rotors",
        PAPER | arm(0.5, 4.0),
        ADMITTANCE,
    ),
    Case(
        "half the friction, λ = 10 1/s",
        PAPER | arm(0.5) | {"integral_lambda": 10.0},
        ADMITTANCE,
    ),
    Case("the file's values", {}),
)


def measure(case: Case) -> dict[str, float]:
    """Play the pushes of figures 6 to 9 and the curves of figures 10 and 11."""
    loop = DirectLoop(ROBOT, case.changed)
    direction, holds = weakest_direction(loop, ELBOW)
    found = {"elbow_n": PUSH * holds}
    for key, changed in zip(("without", "with"), MODES.values(), strict=True):
        run = judge(push(case.changed | changed, elbow=PUSH * holds))
        found |= {f"{key}_{name}": value for name, value in run.items()}
    pushes = [(1.0, 3.0, ELBOW, PUSH * holds * direction), (4.0, 6.0, HAND, PULL)]
    led = lead(pushes, 7.5, changed=case.changed, admittance=case.admittance)
    place = np.linalg.norm(led.place, axis=1)
    moved = np.abs(led.joints - led.joints[led.at(1.0)])[led.at(1.0) : led.at(3.0)]
    pulled, released = led.at(4.0), led.at(6.0)
    found |= {
        "dual_hand_m": float(place[:pulled].max()),
        "dual_joint_rad": float(moved.max()),
        "led_m": float(np.linalg.norm(led.place[released] - led.place[pulled])),
    }
    for key, poles in (("free", ()), ("poles", POLES)):
        curve = judge_curve(draw(case.changed | COMPLIANT, poles, turns=1))
        found[f"{key}_m"] = curve["hand_m"]
    return found


def _easier(found: Mapping[str, float]) -> bool:
    return found["with_witness_motion_rad"] >= 3.0 * found["without_witness_motion_rad"]


Told = Callable[[Mapping[str, float]], str]
Holds = Callable[[Mapping[str, float]], bool]

STATEMENTS: tuple[tuple[str, str, Told, Holds | None], ...] = (
    (
        "Fig. 6 to 8: elbow pushed, a joint moves without / with",
        "hardly / much easier (no number)",
        lambda found: (
            f"{found['elbow_n']:.0f} N: {found['without_witness_motion_rad']:.3f} / "
            f"{found['with_witness_motion_rad']:.3f} rad"
        ),
        _easier,
    ),
    (
        "the hand meanwhile, without / with",
        "stiff / still stiff (no number)",
        lambda found: (
            f"{1e3 * found['without_elbow_hand_m']:.1f} / {1e3 * found['with_elbow_hand_m']:.1f} "
            f"mm, {np.degrees(found['without_elbow_hand_rad']):.1f} / "
            f"{np.degrees(found['with_elbow_hand_rad']):.1f}°"
        ),
        None,
    ),
    (
        f"Fig. 6: hand pushed with {HAND_FORCE:.0f} N, its error without / with",
        "stiff / also stiff (no number)",
        lambda found: (
            f"{1e3 * found['without_steady_m']:.2f} / {1e3 * found['with_steady_m']:.2f} mm"
        ),
        lambda found: found["with_steady_m"] <= 1.1 * found["without_steady_m"],
    ),
    (
        "Fig. 9: elbow pushed for 2 s, joint and hand",
        "the hand stays where it is (no number)",
        lambda found: f"{found['dual_joint_rad']:.3f} rad, {1e3 * found['dual_hand_m']:.1f} mm",
        None,
    ),
    (
        f"Fig. 9: hand led with {PULL[0]:.0f} N for 2 s",
        "moved freely (no number)",
        lambda found: f"{1e3 * found['led_m']:.1f} mm",
        lambda found: found["led_m"] >= 0.02,
    ),
    (
        "Fig. 10, 11: a turn of 40 cm in 8 s, without poles",
        "-",
        lambda found: f"{1e3 * found['free_m']:.1f} mm",
        None,
    ),
    (
        "Fig. 10, 11: the same among two poles",
        "under 20 mm",
        lambda found: f"{1e3 * found['poles_m']:.1f} mm",
        lambda found: found["poles_m"] < 0.02,
    ),
)


def own_values() -> Figure:
    """All statements of figures 6 to 11, by values and arm."""
    figure = Figure(VALUES_NAME)
    found = {case.name: measure(case) for case in CASES}
    for name, each in found.items():
        figure.metrics |= {f"{name}: {key}": value for key, value in each.items()}
    for what, paper, told, holds in STATEMENTS:
        cells = []
        for each in found.values():
            judged = "" if holds is None else f": **{'so' if holds(each) else 'not so'}**"
            cells.append(told(each) + judged)
        figure.rows.append((what, paper, *cells))
    figure.save(None)
    return figure


VALUES_HEADS = ("figure", "the paper", *(case.name for case in CASES))

FRICTIONS = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the file's
GAINS = (2.0, 10.0, 100.0)  # 1/s
ROTORS = (1.0, 4.0)


def stiction() -> Figure:
    """The elbow pushed, by friction, rotors and lambda, with the paper's budget of 10%."""
    figure = Figure(STICTION_NAME)
    picture, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    shares = STICTION * np.array(FRICTIONS)
    for rotors in ROTORS:
        for gain in GAINS if rotors == 1.0 else GAINS[:1]:
            rows = np.array([_pushed(friction, rotors, gain) for friction in FRICTIONS])
            name = f"λ = {gain:g} 1/s" + (", 4 times the rotors" if rotors != 1.0 else "")
            figure.data[name] = np.column_stack([shares, rows])
            without, with_it, hand_without, hand = rows.T
            axes[0].plot(shares, with_it / without, "o-", label=name)
            (line,) = axes[1].plot(shares, 1e3 * hand, "o-", label=f"{name}, with")
            axes[1].plot(shares, 1e3 * hand_without, "o:", color=line.get_color(), mfc="none")
            cells = [
                f"{w / o:.1f}; {1e3 * ho:.1f} / {1e3 * h:.1f} mm"
                for o, w, ho, h in zip(without, with_it, hand_without, hand, strict=True)
            ]
            figure.rows.append((name, *cells))
    axes[0].set(ylabel="null-space joint moves further with, times", yscale="log")
    axes[1].set(ylabel="hand off its goal, at most [mm]; dotted: without", yscale="log")
    for axis in axes:
        axis.set_xlabel("stiction [% of the torque limits]")
        axis.axvline(10.0, color="black", linestyle="--", lw=1)
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small", title="dashed: the budget")
    figure.save(picture)
    return figure


def _pushed(friction: float, rotors: float, gain: float) -> tuple[float, float, float, float]:
    """Return how far a joint moved without and with, rad, and the hand's errors, m."""
    changed = PAPER | arm(friction, rotors) | {"integral_lambda": gain}
    _, holds = weakest_direction(DirectLoop(ROBOT, changed), ELBOW)
    without, with_it = (
        judge(push(changed | mode, hand=0.0, elbow=HARD_PUSH * holds)) for mode in MODES.values()
    )
    return (
        without["witness_motion_rad"],
        with_it["witness_motion_rad"],
        without["elbow_hand_m"],
        with_it["elbow_hand_m"],
    )


STICTION_HEADS = ("stiction", *(f"{STICTION * friction:.1f}%" for friction in FRICTIONS))


def tables(figures: list[Figure]) -> str:
    """Return the tables of this module's figures and that of all others."""
    heads = {VALUES_NAME: VALUES_HEADS, STICTION_NAME: STICTION_HEADS}
    own = [table([figure], heads[figure.name]) for figure in figures if figure.name in heads]
    rest = [figure for figure in figures if figure.name not in heads]
    return "\n\n".join([*own, *([table(rest)] if rest else [])])
