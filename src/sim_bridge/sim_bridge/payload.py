# SPDX-License-Identifier: Apache-2.0
"""Payloads: bodies mounted on links of a URDF."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree.ElementTree import SubElement, fromstring, tostring

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from sim_bridge.urdf import number_text
from viability_bounds_pkg.exceptions import ArmSafetyError

_ROUNDING = 1e-9  # share of the largest moment of inertia


class PayloadError(ArmSafetyError, ValueError):
    """A payload that no body can be, or on a link that does not move."""


def payload_inertia(link: str, mass: float, centre: ArrayLike, moments: ArrayLike) -> pin.Inertia:
    """Return the inertia of a payload in the frame of its link.

    Args:
        link: that it is mounted on, for errors.
        mass: positive, kg.
        centre: of mass, in the link's frame, shape (3,), m.
        moments: of inertia about its centre, in the link's axes: xx, xy, xz, yy, yz, zz, shape
            (6,), kg m^2; zeros for a point mass.

    Raises:
        PayloadError: one of them is invalid.
    """
    c, m = np.asarray(centre, dtype=float), np.asarray(moments, dtype=float)
    if not np.isfinite([mass, *c, *m]).all():
        raise PayloadError(f"payload of link {link!r}: it has numbers that are not finite")
    if not mass > 0.0:
        raise PayloadError(f"payload of link {link!r}: its mass is {mass:g} kg; allowed: > 0")
    xx, xy, xz, yy, yz, zz = m
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    small, middle, large = np.linalg.eigvalsh(matrix)
    tolerance = _ROUNDING * max(abs(small), large)
    if small < -tolerance or small + middle < large - tolerance:
        raise PayloadError(
            f"payload of link {link!r}: its principal moments of inertia are {small:g}, "
            f"{middle:g} and {large:g} kg m^2; allowed: none negative, none above the sum of the "
            "others"
        )
    try:
        return pin.Inertia(mass, c, matrix)
    except (RuntimeError, ValueError) as error:  # Pinocchio tolerates less
        raise PayloadError(f"payload of link {link!r}: {error}") from error


def payload_link(link: str) -> str:
    """Return the name of the link that the payload of `link` is in `with_payloads`."""
    return f"{link} payload"


def with_payloads(urdf: str, payloads: Mapping[str, pin.Inertia]) -> str:
    """Return a URDF with payloads, each a link of its own.

    Args:
        urdf: text of the URDF.
        payloads: in the frames of the links that carry them, by link.
    """
    if not payloads:
        return urdf
    root = fromstring(urdf)
    for link, payload in payloads.items():
        name = payload_link(link)
        inertial = SubElement(SubElement(root, "link", name=name), "inertial")
        SubElement(inertial, "origin", xyz=number_text(payload.lever))
        SubElement(inertial, "mass", value=number_text([payload.mass]))
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = payload.inertia.tolist()
        moments = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
        SubElement(inertial, "inertia", {key: repr(x) for key, x in moments.items()})
        joint = SubElement(root, "joint", name=name, type="fixed")
        SubElement(joint, "parent", link=link)
        SubElement(joint, "child", link=name)
    return tostring(root, encoding="unicode")
