# SPDX-License-Identifier: Apache-2.0
"""Figures 6 to 11 of [Benallegue2021]: stiff at the hand, free in the null space.

bash scripts/reproduce.sh paper1-compliance            all, and docs/reproduction_compliance.md
bash scripts/reproduce.sh paper1-compliance fig6       one part

TALOS' torso and left arm, 9 joints at 1 kHz, with friction of 10% of the torque limits (stiction
13%), rotors, and links 10% heavier than the controller knows: `config/talos_left_arm.yaml`. What
is compared is its integral action ``joints`` with ``task``; all else is the same.
"""

from __future__ import annotations

from collections.abc import Callable

from chain import ROOT
from compliance_curve import adverse, figure_10, switching
from compliance_hand import dual, pressing
from compliance_push import figure_6, forces
from compliance_stills import embed, figure_10_stills, figures_7_and_8
from figure import Figure, reproduce, table


def figure_9() -> Figure:
    """Dual compliance."""
    figure = Figure("paper1-fig9")
    dual(figure)
    return figure


def press() -> Figure:
    """Pressing on a table, sliding along it."""
    figure = Figure("paper1-press")
    pressing(figure)
    return figure


PARTS: dict[str, Callable[[], Figure]] = {
    "fig6": figure_6,
    "fig7": figures_7_and_8,
    "force": forces,
    "fig9": figure_9,
    "fig10": figure_10,
    "stills": figure_10_stills,
    "adverse": adverse,
    "switching": switching,
    "press": press,
}
PAGE = """# Results beside the paper: compliance

Written by `bash scripts/reproduce.sh paper1-compliance`; do not edit.
[Benallegue2021] on TALOS' torso and left arm at 1 kHz, with friction, rotors and mass errors,
parameters as in `config/talos_left_arm.yaml`, which has the paper's gains of pose and posture;
"without" is integral action `joints`, "with" is `task`. Forces rise within 0.3 s. Pictures and
data are under `results/`.

{table}

![Elbow pushed, without and with null-space compliance](images/compliance.png)

Above without, below with null-space compliance; the cross marks the initial place of the elbow.

![Curve among poles](images/poles.png)

At the start, and at the largest pole force in each of three turns. Red: the reference.

[Benallegue2021]: references.md
"""


def write_document(figures: list[Figure]) -> None:
    """Write docs/reproduction_compliance.md and its pictures."""
    embed()
    page = PAGE.format(table=table(figures))
    (ROOT / "docs" / "reproduction_compliance.md").write_text(page)


if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, PARTS, write_document))
