# SPDX-License-Identifier: Apache-2.0
"""Finds and reads URDF files.

A URDF is named by a file path or by a ``package://`` URI. Packages are looked up where ROS 2
looks (``AMENT_PREFIX_PATH``, ``ROS_PACKAGE_PATH``), where the ``example-robot-data`` wheel puts
its robots, and among Python's own packages, so that one parameter file works with all.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.robot.mistakes import urdf_mistakes


class RobotDescriptionError(ArmSafetyError, ValueError):
    """A URDF that cannot be found or loaded, or that does not fit what is asked of it.

    Attributes:
        parameter: which parameter of a robot is at fault.
    """

    def __init__(self, message: str, parameter: str = "robot_description") -> None:
        self.parameter = parameter
        super().__init__(message)


def package_directories() -> Iterator[Path]:
    """Yield the directories whose children are packages, in order of precedence."""
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / "share"
    for root in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield Path(root)
        if (Path(root) / "package.xml").is_file():  # it is a package itself
            yield Path(root).parent
    for entry in sys.path:
        yield Path(entry) / "cmeel.prefix" / "share"


def resolve_uri(uri: str) -> Path:
    """Return the file that a path, ``file://`` or ``package://`` URI names.

    Args:
        uri: what to look up; a package name is the first component of a ``package://`` URI.

    Raises:
        RobotDescriptionError: no such file.
    """
    if uri.startswith("package://"):
        relative = uri.removeprefix("package://").lstrip("/")  # some write three
        # Of Python's packages only files: an ament_python package has a folder there, too.
        for directory in (*package_directories(), *map(Path, sys.path)):
            path = directory / relative
            if path.is_file():
                return path
        package = relative.split("/", 1)[0]
        hint = _other_file(*(directory / relative for directory in package_directories()))
        raise RobotDescriptionError(f"{uri}: no package {package!r} holds this file{hint}")
    path = Path(uri.removeprefix("file://")).expanduser()
    if not path.is_file():
        raise RobotDescriptionError(f"{uri}: no such file{_other_file(path)}")
    return path


def package_folder(name: str, beside: Path) -> Path:
    """Return the folder of a package: where packages are looked up, or around or beside a file.

    Raises:
        RobotDescriptionError: there is none.
    """
    for directory in package_directories():
        if (directory / name).is_dir():
            return directory / name
    for folder in beside.resolve().parents:
        if name in (folder.name, _declared_name(folder)):
            return folder
        if (folder / name).is_dir():
            return folder / name
    raise RobotDescriptionError(
        f"no package '{name}' in the folders of ROS_PACKAGE_PATH, nor in AMENT_PREFIX_PATH"
    )


def _declared_name(folder: Path) -> str:
    """Return the name of the package that a folder is by its manifest; empty if it is none."""
    manifest = folder / "package.xml"
    try:
        return ElementTree.parse(manifest).findtext("name", "") if manifest.is_file() else ""
    except ElementTree.ParseError:
        return ""


def with_near_packages(text: str, path: Path) -> str:
    """Return a URDF with names of meshes that depend on its place made absolute.

    These are names relative to its folder, and ``package://`` URIs of packages around or beside
    its file; a package that is installed keeps them.
    """

    def place(uri: re.Match[str]) -> str:
        if any((directory / uri[1]).is_dir() for directory in package_directories()):
            return uri[0]
        try:
            return f"file://{package_folder(uri[1], path)}/"
        except RobotDescriptionError:
            return uri[0]

    def beside(name: re.Match[str]) -> str:
        file = path.parent.resolve() / name[1]
        return f'filename="file://{file}"' if file.is_file() else name[0]

    text = re.sub(r'filename="(?![a-z]+://|/)([^"]+)"', beside, text)
    return re.sub(r"package:///*([\w.-]+)/", place, text)


def _other_file(*paths: Path) -> str:
    """Return a hint at a file beside one that does not exist; empty if none has such a name."""
    beside = [path.parent for path in paths if path.parent.is_dir()]
    return did_you_mean(
        paths[0].name, [each.name for folder in beside for each in folder.iterdir()]
    )


def read_urdf(uri: str) -> str:
    """Return the text of the URDF that `uri` names, checked by `check_urdf`.

    Raises:
        RobotDescriptionError: the file is missing, unreadable or is not a URDF.
    """
    text = urdf_text(resolve_uri(uri), uri)
    check_urdf(text, uri)
    return text


def urdf_text(path: Path, source: str) -> str:
    """Return the text of a URDF file, in UTF-8 or in the encoding that its first line names.

    Names of meshes in packages around or beside it are those of files.

    Raises:
        RobotDescriptionError: it cannot be read; names `source`.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RobotDescriptionError(f"{source}: {error}") from error
    declared = re.match(rb"""\s*<\?xml[^>]*encoding=["']([\w.-]+)""", data)
    encoding = declared[1].decode() if declared else "utf-8"
    for each in ("utf-8", encoding):
        try:
            return with_near_packages(data.decode(each), path)
        except (LookupError, UnicodeDecodeError):
            continue
    raise RobotDescriptionError(
        f"{source}: is not in {encoding}, nor in UTF-8; iconv -f ENCODING -t UTF-8 converts it"
    )


def check_urdf(text: str, source: str) -> None:
    """Raise `RobotDescriptionError`, naming `source`, unless `text` is a URDF without mistakes."""
    if found := urdf_mistakes(parsed_urdf(text, source)):
        raise RobotDescriptionError(f"{source}: {'; '.join(found)}")


def parsed_urdf(text: str, source: str) -> ElementTree.Element:
    """Return the element of the robot; raise `RobotDescriptionError` if there is none."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise RobotDescriptionError(f"{source}: not well-formed XML ({error})") from error
    if root.tag != "robot":
        raise RobotDescriptionError(f"{source}: root element is <{root.tag}>, not <robot>")
    if any("xacro}" in element.tag for element in root.iter() if isinstance(element.tag, str)):
        raise RobotDescriptionError(f"{source}: is for xacro; xacro {source} > robot.urdf")
    if root.find("link") is None:
        raise RobotDescriptionError(f"{source}: there is no <link> in it")
    return root
