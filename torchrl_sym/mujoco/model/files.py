"""Models from files, also those whose robot is nailed to the world.

A URDF says nothing of where its root link is: MuJoCo makes it the world, so that it can neither move nor
weigh anything. Many MJCF files of drones and legged robots leave their free joint to the scene.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from torchrl_sym.mujoco.model.types import mj


def load_spec(path: str | Path, free_base: bool = False) -> Any:
    """The specification in an MJCF or URDF file, with the base of its robot set free if that is asked for.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is no model, or it is not clear which body is the base; the message says why.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    if not free_base:
        return _parsed(path)
    try:
        root = ET.parse(path).getroot() if path.suffix != ".xml" or _is_urdf(path) else None
    except ET.ParseError as error:
        raise _unreadable(path, error) from error
    if root is not None and root.tag == "robot":
        return _free_urdf(path, root)
    spec = _parsed(path)
    free_the_base(spec)
    return spec


def _parsed(path: Path) -> Any:
    try:
        return mj.MjSpec.from_file(str(path))
    except ValueError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ValueError:
    return ValueError(f"expected an MJCF or URDF file, {path} is none that can be read: {error}")


def free_the_base(spec: Any) -> None:
    """Give the one body of the world that moving parts hang on, or else the only one, a free joint.

    Raises:
        ValueError: it is free already, or several bodies could be the base.
    """
    bodies = list(spec.worldbody.bodies)
    jointed = [body for body in bodies if body.joints or any(b.joints for b in body.find_all("body"))]
    candidates = jointed or bodies
    if len(candidates) != 1:
        names = [body.name or f"body {body.id}" for body in candidates]
        raise ValueError(
            f"expected one body of the world to set free, got {names}; add a freejoint to the file"
        )
    (base,) = candidates
    if base.joints:
        raise ValueError(f"{base.name!r} moves already: it has joints of its own; leave out the free base")
    base.add_freejoint()


def _is_urdf(path: Path) -> bool:
    return "<robot" in path.read_text(errors="ignore")


def _free_urdf(path: Path, root: ET.Element) -> Any:
    """URDF with a link for the world, to which a floating joint ties the root."""
    links = [link.get("name") for link in root.findall("link")]
    children = {joint.find("child").get("link") for joint in root.findall("joint")}  # pyright: ignore[reportOptionalMemberAccess]
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise ValueError(f"expected one root link to set free, got {roots}")
    if roots[0] == "world":
        raise ValueError("the root link is 'world' already; make its joint of type floating")
    world = ET.SubElement(root, "link", name="world")
    joint = ET.SubElement(root, "joint", name="free_base", type="floating")
    ET.SubElement(joint, "parent", link=world.get("name", ""))
    ET.SubElement(joint, "child", link=roots[0] or "")
    spec = mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.modelfiledir = str(path.parent)
    return spec
