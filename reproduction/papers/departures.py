# SPDX-License-Identifier: Apache-2.0
"""Where the controller departs from [Benallegue2021], each with a number; docs/departures.md.

bash scripts/reproduce.sh departures              all of it, and docs/departures.md
bash scripts/reproduce.sh departures null-space   one part

TALOS' torso and left arm at 1 kHz, `config/talos_left_arm.yaml`; "the paper's values" are those of
its section IV-A.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pinocchio as pin
from chain import ROOT
from compliance_push import MODES, ROBOT, judge, push
from compliance_values import PAPER
from direct import DirectLoop, column
from figure import Figure, reproduce, table
from paper1_integral import Disturbed
from paper1_integral import push as push_hand

from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors

COMPLIANT = MODES["with null-space compliance"]
HEADS = ("part", "the paper", "here, and why", "switch to the paper's form", "here", "switched")


def _figure(name: str, *row: str) -> Figure:
    figure = Figure(f"departures-{name}")
    figure.rows.append(row)
    return figure


def pose_error() -> Figure:
    """How far the hand is from the straight line to a goal 0.3 m and 90 degrees away."""
    found = {kind: _off_line(kind) for kind in ("separate", "logarithm")}
    return _figure(
        "pose-error",
        "pose error",
        "(7)-(8): position and orientation apart, in the world's axes",
        "the same; the logarithm of SE(3) is there to compare with",
        "none needed; `pose_error: logarithm` is the other form",
        f"goal 0.3 m and 90° away: hand at most {1e3 * found['separate']:.1f} mm off the straight "
        "line",
        f"logarithm: {1e3 * found['logarithm']:.1f} mm",
    )


def _off_line(kind: str) -> float:
    loop = DirectLoop(ROBOT, {"pose_error": kind, "pose_kp": 20.0, "pose_kd": 9.0})
    start = loop.pose()
    turned = start.rotation @ pin.exp3(np.array([0.0, 0.0, 0.5 * np.pi]))
    end = start.translation + np.array([0.1, -0.2, 0.2])
    loop.controller.set_pose_goal(pin.SE3(turned, end))
    line = (end - start.translation) / np.linalg.norm(end - start.translation)
    off = [0.0]

    def each(_: float) -> None:
        way = loop.pose().translation - start.translation
        off.append(float(np.linalg.norm(way - line * (line @ way))))

    loop.run(3.0, each)
    return max(off)


def weights() -> Figure:
    """The elbow pushed with weights as printed: squared, because they are inside the norm."""
    squared = {"pose_weight": 1e5, "posture_weight": 0.1}
    found = [judge(push(COMPLIANT | each, hand=0.0)) for each in ({}, squared)]
    told = [
        f"elbow pushed with 100 N: hand within {1e3 * each['elbow_hand_m']:.2f} mm, a joint moves "
        f"{each['witness_motion_rad']:.3f} rad"
        for each in found
    ]
    return _figure(
        "weights",
        "weights",
        "inside the norm of (5): they count squared",
        "outside; Table I's 10000 to 10 is a ratio of 1e3 here, of "
        "1e6 there. The posture task acts in the null space of the pose, so little depends on it",
        "the squares' ratio: `pose_weight: 1.0e5`, `posture_weight: 0.1`",
        *told,
    )


def constraints() -> Figure:
    """Random pushes and goals, with the observer of disturbances and without."""
    told = []
    for changed in ({}, {"disturbance_time": -1.0}):
        run = Disturbed(changed)
        run.run(0.5)
        told.append(
            f"half a minute of pushes: a limit passed in {run.beyond} of {run.steps} steps, by up "
            f"to {1e3 * run.deepest:.1f} mrad"
        )
    return _figure(
        "constraints",
        "integral in the constraints",
        "a force in all constraints, those of motion, too (III-E)",
        "in the torque limits only: where the integral balances what disturbs the arm, the arm "
        "does as the QP says without it. What it does not balance is estimated from the motion, "
        "and tightens the bounds",
        "none for the force in the bounds; `disturbance_time: -1.0` for no observer",
        *told,
    )


def leak() -> Figure:
    """What a step takes of the increment of s."""
    gains = [leak_factors(100.0, 1e-3, printed)[1] for printed in (False, True)]
    return _figure(
        "leak",
        "leaky integrator",
        "(13): all of the increment",
        "(12) solved for a step in which s' is constant: any rate and any period are the same law",
        "`integral_anti_windup: paper`, `scaling` or `none`",
        f"theta_f at 1 kHz: {gains[0]:.4f} of the increment",
        f"{gains[1]:.4f}: {100.0 * (gains[1] / gains[0] - 1.0):.1f}% too much",
    )


def whole_torque() -> Figure:
    """The hand pushed down with 100 N for 5 s and let go, the paper's values."""
    told = []
    for changed in (PAPER, PAPER | {"integral_anti_windup": "paper"}):
        run = push_hand(changed, (0.0, 0.0, -100.0))
        told.append(
            f"100 N at the hand let go: {run['share']:.2f} budgets, overshoot "
            f"{1e3 * run['overshoot']:.1f} mm"
        )
    return _figure(
        "whole-torque",
        "limit of the integral",
        "K s only, (10) or (11); C s and the integrators are left alone",
        "all of the torque, integrators included: a budget is a budget, and s is not wound up "
        "behind it",
        "`integral_anti_windup: paper` for (11), `scaling` for (10)",
        *told,
    )


def null_space() -> Figure:
    """The elbow pushed, by the law as it is and as printed, with both sets of values."""
    told = []
    for printed in (False, True):
        cells = []
        for name, values in (("the paper's", PAPER), ("the file's", {})):
            method = {"integral_anti_windup": "paper"} if printed else {}
            run = push(COMPLIANT | values | method, hand=0.0)
            found = judge(run)
            budget = run.loop.controller.additional.settings.integral.budget
            most = (np.abs(column(run.samples, "additional")) / budget).max()
            cells.append(
                f"{name} values: a joint moves {found['witness_motion_rad']:.3f} rad, hand within "
                f"{1e3 * found['elbow_hand_m']:.1f} mm, torque at most {most:.1f} budgets"
            )
        told.append("; ".join(cells))
    return _figure(
        "null-space",
        "null-space law",
        "(16), (21), (26): only K a leaks and is limited; s and integral(J's) grow under a "
        "lasting push in the null space",
        "all states leak, in the null space at theta_null, and a alone is stored: the energy of "
        "all of it falls, and budgets hold for all of the torque "
        "([nullspace_compliance.md](nullspace_compliance.md))",
        "`integral_anti_windup: paper`, `scaling` or `none`; the fourth number of `integral_leak` "
        "is theta_null",
        *(f"elbow pushed with 100 N: {each}" for each in told),
    )


def reference_force() -> Figure:
    """What (27) goes by."""
    return _figure(
        "reference-force",
        "F_ref of (27)",
        "the force that the QP found in the last step",
        "the target, less what the QP could not count on: the QP counts on no more than is "
        "measured, or the hand would leap before it touches ([forces.md](forces.md))",
        "none",
        "Panda: [reproduction_compliance.md](reproduction_compliance.md), Eq. (27)",
        "-",
    )


PARTS: Mapping[str, Callable[[], Figure]] = {
    "pose-error": pose_error,
    "weights": weights,
    "constraints": constraints,
    "reference-force": reference_force,
    "leak": leak,
    "whole-torque": whole_torque,
    "null-space": null_space,
}
PAGE = """# Departures from the second paper

Written by `bash scripts/reproduce.sh departures`; do not edit.
Where the controller is not what [Benallegue2021] prints: why, the parameters that give the paper's
form, and what differs on TALOS' torso and left arm at 1 kHz, with the values of
`config/talos_left_arm.yaml` unless the paper's are named (lambda = 2 1/s, budgets of 10%).

{table}

Where the text of the paper cannot be meant as printed, both forms of the law here follow the
derivation: J^+ has shape (n, m), not (m, n); u^r after (21) has C dq, not C dq^r, as in (2); (17)
is dq^a and (19) its derivative; the second condition of (11) has a for s where (26) is limited.
How integral(J's) is computed from samples the paper does not say: by the product rule, which makes
(25) exact. Near singularities J^+ is damped, where the paper assumes full rank. K is lambda
diag(M), or lambda M with `integral_anti_windup: paper_mass`; where the posture makes lambda too
large for the period it is lowered, which the paper's 2 1/s at 1 kHz never is
([gains.md](gains.md#a-stable-integral-gain)).

Not there: the improvement of (27) for internal forces, which the paper names and does not
describe, more than two end effectors in the node, and the unactuated joints of III-E: bases are
fixed.

[Benallegue2021]: references.md
"""


def show(figures: list[Figure]) -> str:
    """Return the table."""
    return table(figures, HEADS)


def write_document(figures: list[Figure]) -> None:
    """Write docs/departures.md."""
    (ROOT / "docs" / "departures.md").write_text(PAGE.format(table=show(figures)))


if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, PARTS, write_document, show))
