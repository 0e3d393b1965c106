# SPDX-License-Identifier: Apache-2.0
"""Figures 6 to 11 of [Benallegue2021]: stiff at the hand, free in the null space.

bash scripts/reproduce.sh paper1-compliance            all, and tables of docs/results.md
bash scripts/reproduce.sh paper1-compliance fig6       one part

TALOS' torso and left arm, 9 joints at 1 kHz, with friction of 10% of the torque limits (stiction
13%), rotors, and links 10% heavier than the controller knows: `config/talos_left_arm.yaml`. What
is compared is its integral action ``joints`` with ``task``; all else is the same.
"""

from __future__ import annotations

from compliance_curve import figure_10
from compliance_hand import figure_9, pressing
from compliance_push import figure_6
from compliance_stills import figure_10_stills, figures_7_and_8
from compliance_values import own_values, stiction
from figure import reproduce

PARTS = {
    "values": own_values,
    "stiction": stiction,
    "fig6": figure_6,
    "fig7": figures_7_and_8,
    "fig9": figure_9,
    "fig10": figure_10,
    "stills": figure_10_stills,
    "press": pressing,
}

if __name__ == "__main__":
    raise SystemExit(reproduce(__doc__, PARTS))
