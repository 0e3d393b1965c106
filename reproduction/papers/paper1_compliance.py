# SPDX-License-Identifier: Apache-2.0
"""Figures 6 to 11 of [Benallegue2021]: stiff at the hand, free in the null space.

bash scripts/reproduce.sh paper1-compliance            all, and tables of docs/results.md
bash scripts/reproduce.sh paper1-compliance fig6       one part

TALOS' torso and left arm, 9 joints at 1 kHz, with friction of 10% of the torque limits (stiction
13%), rotors, and links 10% heavier than the controller knows: `config/talos_left_arm.yaml`. What
is compared is its integral action ``joints`` with ``task``; all else is the same.
"""

from __future__ import annotations

from collections.abc import Callable

from compliance_curve import adverse, figure_10
from compliance_hand import dual, pressing
from compliance_push import figure_6, forces
from compliance_stills import embed, figure_10_stills, figures_7_and_8
from compliance_values import (
    STICTION_HEADS,
    STICTION_NAME,
    VALUES_HEADS,
    VALUES_NAME,
    own_values,
    stiction,
    tables,
)
from figure import Figure, reproduce, table, write_part


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
    "values": own_values,
    "stiction": stiction,
    "fig6": figure_6,
    "fig7": figures_7_and_8,
    "force": forces,
    "fig9": figure_9,
    "fig10": figure_10,
    "stills": figure_10_stills,
    "adverse": adverse,
    "press": press,
}


def write_document(figures: list[Figure]) -> None:
    """Write the tables of docs/results.md, and its pictures."""
    embed()
    by_name = {figure.name: figure for figure in figures}
    write_part(VALUES_NAME, table([by_name.pop(VALUES_NAME)], VALUES_HEADS))
    write_part(STICTION_NAME, table([by_name.pop(STICTION_NAME)], STICTION_HEADS))
    write_part("paper1-compliance", table(list(by_name.values())))


if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, PARTS, write_document, tables))
