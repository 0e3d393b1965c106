# SPDX-License-Identifier: Apache-2.0
"""The shapes of a URDF, loaded through Pinocchio and coal."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from xml.etree import ElementTree

import pinocchio as pin

from viability_bounds_pkg.robot_description import (
    RobotDescriptionError,
    package_directories,
    resolve_uri,
)


def load_geometry(
    urdf: str,
    model: pin.Model,
    locked_positions: Mapping[str, float] | None = None,
    kind: str = "collision",
) -> pin.GeometryModel:
    """Return the geometry for a model of `robot_description.build_model`.

    Args:
        urdf: text of the URDF.
        model: made of it, other joints locked.
        locked_positions: as given to `build_model`, rad.
        kind: "collision" or "visual"; of the latter, shapes that are not understood are left out.

    Raises:
        RobotDescriptionError: a mesh cannot be found or loaded, or a shape is not understood.
    """
    # Pinocchio's own error does not name the mesh.
    for mesh in ElementTree.fromstring(urdf).iterfind(f".//{kind}//mesh"):
        if "://" in (name := mesh.get("filename", "")):
            resolve_uri(name)
    full = pin.buildModelFromXML(urdf)
    directories = [str(path) for path in package_directories() if path.is_dir()]
    which = getattr(pin.GeometryType, kind.upper())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pinocchio, about how it was called
            geometry = pin.buildGeomFromUrdfString(full, urdf, which, directories)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f"{kind} geometry does not load: {error}") from error
    if kind == "collision":
        _check_complete(urdf, full, geometry)
    configuration = pin.neutral(full)
    for name, position in (locked_positions or {}).items():
        configuration[full.joints[full.getJointId(name)].idx_q] = position
    kept = set(model.names)
    locked = [i for i in range(1, full.njoints) if full.names[i] not in kept]
    reduced, (geometry,) = pin.buildReducedModel(full, [geometry], locked, configuration)
    if list(reduced.names) != list(model.names):
        raise RobotDescriptionError("the model was not made of this URDF")
    return geometry


def _check_complete(urdf: str, model: pin.Model, geometry: pin.GeometryModel) -> None:
    """Raise if a shape of the URDF is missing: its parser drops what it does not understand."""
    found = Counter(model.frames[item.parentFrame].name for item in geometry.geometryObjects)
    for link in ElementTree.fromstring(urdf).iter("link"):
        name, shapes = link.get("name", ""), len(link.findall("collision"))
        if model.existFrame(name) and found[name] != shapes:
            raise RobotDescriptionError(
                f"link {name!r}: only {found[name]} of {shapes} collision shapes were understood"
            )
