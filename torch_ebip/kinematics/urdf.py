"""The joints of a URDF file, and nothing else of it: from the root link to one that is asked for."""

from __future__ import annotations

import math
from os import PathLike
from typing import Any, NamedTuple
from xml.etree import ElementTree

from torch_ebip.common.files import read_text

LIMIT = 1 << 24
"""Bytes of a URDF."""
MOST_ELEMENTS = 100_000
"""Of its tree, each of which takes a hundred times its bytes in memory."""
MOST_JOINTS = 100
"""On the way to a link: the chain is copied by recursion."""
LARGEST = 1e6
"""Metres, radians; beyond it rounding is all that is left of a pose."""
WIDEST = 1e18
"""Of limits: a file may say so where it means none."""
TYPES = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}
"""Types of joints, and how they move."""

Vector = tuple[float, ...]


class UrdfJoint(NamedTuple):
    """A joint.

    Attributes:
        name: unique.
        kind: one of the values of `TYPES`.
        child: the link that it moves.
        xyz, rpy: its origin in the parent's frame, m and rad.
        axis: of its motion, in its own frame; any length but 0.
        limits: least and largest position, rad or m; None if there are none.
        speed: the largest, rad/s or m/s; None if it is not stated.
        mimic: the joint that it follows, multiplier and offset; None if it moves on its own.
    """

    name: str
    kind: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector
    limits: tuple[float, float] | None
    speed: float | None
    mimic: tuple[str, float, float] | None


def read_urdf(urdf: str | PathLike[str]) -> str:
    """The text of a URDF given as such or by its path.

    Raises:
        ValueError: a file that is not there, is too large or is not text in UTF-8.
    """
    if isinstance(urdf, str) and urdf.lstrip().startswith("<"):
        return urdf
    try:
        return read_text(urdf, LIMIT)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"urdf: expected the path of a readable URDF file or its XML text, got {str(urdf)[:80]!r} ({error})"
        ) from error


def chain_of_joints(text: str, end_link: str, root_link: str | None = None) -> tuple[str, list[UrdfJoint]]:
    """The root link and the joints from it to a link, wherever in the text they stand.

    Args:
        text: of the URDF.
        end_link: name of a link.
        root_link: a link on the way to it, to begin at; default: the root of the tree.

    Raises:
        ValueError: no URDF, one that declares entities, no such link, no tree; a joint of another type, with
            numbers that give no pose, or that follows one that is not on the way.
    """
    robot = _parse(text)
    names = [link.get("name", "") for link in robot.findall("link")]
    for argument, asked in (("end_link", end_link), ("root_link", root_link)):
        if asked is not None and asked not in names:
            known = ", ".join(name[:80] for name in names[:20])
            raise ValueError(f"{argument}: expected one of the URDF's links ({known}), got {asked!r}")
    # From the end link up to the root: only these joints matter, whatever else hangs on the robot.
    above: dict[str, ElementTree.Element] = {}
    for joint in robot.findall("joint"):
        child = _link(joint, "child")
        if above.setdefault(child, joint) is not joint:
            raise ValueError(f"urdf: expected a tree of links, got two joints above {child!r}")
    path: list[ElementTree.Element] = []
    link = end_link
    while link in above and link != root_link:
        path.append(above[link])
        link = _link(path[-1], "parent")
        if any(above[link] is joint for joint in path if link in above):
            raise ValueError(f"urdf: expected a tree of links, got a loop through {link!r}")
        if len(path) > MOST_JOINTS:
            raise ValueError(f"urdf: expected at most {MOST_JOINTS} joints from the root to {end_link!r}, got more")
    if root_link is not None and link != root_link:
        raise ValueError(f"root_link: expected a link on the way from {link!r} to {end_link!r}, got {root_link!r}")
    unsupported = [_name(joint) for joint in path if joint.get("type") not in TYPES]
    if unsupported:
        raise ValueError(
            f"urdf: expected joints of type {', '.join(TYPES)} on the way to {end_link!r}, "
            f"got others: {', '.join(unsupported)}"
        )
    joints = [_joint(joint) for joint in reversed(path)]
    if len({joint.name for joint in joints}) != len(joints):
        raise ValueError(f"urdf: expected joints of different names on the way to {end_link!r}")
    return link, joints


def followed(joints: list[UrdfJoint]) -> list[tuple[str, float, float]]:
    """For each joint that moves: which free joint it follows, multiplier and offset; a free one itself, by 1 and 0.

    Raises:
        ValueError: a joint that mimics one that is not among them, does not move, or mimics it in turn.
    """
    moving = {joint.name: joint for joint in joints if joint.kind != "fixed"}
    answer = []
    for joint in moving.values():
        name, multiplier, offset = joint.name, 1.0, 0.0
        seen = [name]
        while (mimic := moving[name].mimic) is not None:
            name, offset, multiplier = mimic[0], offset + multiplier * mimic[2], multiplier * mimic[1]
            if name not in moving:
                raise ValueError(
                    f"urdf: joint {joint.name!r} mimics {name!r}, which does not move on the way to the end link"
                )
            if name in seen:
                raise ValueError(f"urdf: joint {joint.name!r} mimics itself by way of {', '.join(seen[1:]) or name}")
            seen.append(name)
        answer.append((name, multiplier, offset))
    return answer


def _parse(text: str) -> ElementTree.Element:
    if len(text) > LIMIT:
        raise ValueError(f"urdf: {len(text)} characters, expected at most {LIMIT}")
    if "<!DOCTYPE" in text:
        raise ValueError("urdf: declares a document type; entities are not read")
    try:
        # From a str, whatever encoding the text declares: there is none left that could hide a declaration.
        robot = ElementTree.fromstring(text, ElementTree.XMLParser(target=_Counted()))
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"urdf: expected a URDF <robot>, got text that does not parse ({error})") from error
    if robot.tag != "robot":
        raise ValueError(f"urdf: expected a URDF <robot>, got <{robot.tag[:80]}>")
    return robot


class _Counted(ElementTree.TreeBuilder):
    """Builds a tree of at most `MOST_ELEMENTS`."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def start(self, tag: Any, attributes: Any, /) -> Any:
        """One more element."""
        self.count += 1
        if self.count > MOST_ELEMENTS:
            raise ValueError(f"more than {MOST_ELEMENTS} elements")
        return super().start(tag, attributes)


def _joint(joint: ElementTree.Element) -> UrdfJoint:
    name = _name(joint)
    kind = joint.get("type", "")
    origin, axis, limit = joint.find("origin"), joint.find("axis"), joint.find("limit")
    direction = _vector(joint, axis, "xyz", (1.0, 0.0, 0.0))
    if kind != "fixed" and math.hypot(*direction) < 1e-6:
        raise ValueError(f"urdf: joint {name!r}: expected an axis with a direction, got {direction}")
    limits = speed = None
    if limit is not None and kind != "fixed":
        low, high = (_number(joint, limit.get(end, "0"), WIDEST) for end in ("lower", "upper"))
        # The format asks for it; files from the wild leave it out.
        speed = None if limit.get("velocity") is None else _number(joint, limit.get("velocity"), WIDEST)
        if low > high or (speed is not None and speed < 0):
            raise ValueError(f"urdf: joint {name!r}: expected limits, got {low} to {high} at up to {speed}")
        limits = None if kind == "continuous" else (low, high)
    xyz, rpy = (_vector(joint, origin, part, (0.0, 0.0, 0.0)) for part in ("xyz", "rpy"))
    return UrdfJoint(name, TYPES[kind], _link(joint, "child"), xyz, rpy, direction, limits, speed, _mimic(joint))


def _mimic(joint: ElementTree.Element) -> tuple[str, float, float] | None:
    """The joint that a joint follows, multiplier and offset."""
    element = joint.find("mimic")
    if element is None:
        return None
    source = element.get("joint")
    if not source:
        raise ValueError(f"urdf: joint {_name(joint)!r}: expected the name of the joint that it mimics, got none")
    multiplier = _number(joint, element.get("multiplier", "1"), LARGEST)
    return source, multiplier, _number(joint, element.get("offset", "0"), LARGEST)


def _name(joint: ElementTree.Element) -> str:
    name = joint.get("name")
    if not name:
        raise ValueError("urdf: expected a name for every joint, got none")
    return name


def _link(joint: ElementTree.Element, end: str) -> str:
    """The link at an end of a joint, ``parent`` or ``child``."""
    element = joint.find(end)
    name = None if element is None else element.get("link")
    if not name:
        raise ValueError(f"urdf: joint {_name(joint)!r}: expected a {end} link, got none")
    return name


def _vector(joint: ElementTree.Element, element: ElementTree.Element | None, name: str, default: Vector) -> Vector:
    text = None if element is None else element.get(name)
    if text is None:
        return default
    values = tuple(_number(joint, part, LARGEST) for part in text.split(maxsplit=3))
    if len(values) != 3:
        raise ValueError(f"urdf: joint {_name(joint)!r}: expected three numbers in {name}, got {text[:80]!r}")
    return values


def _number(joint: ElementTree.Element, text: str | None, largest: float) -> float:
    """A finite number of at most that magnitude."""
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and abs(number) <= largest):
        raise ValueError(f"urdf: joint {_name(joint)!r}: expected a finite number, got {(text or '')[:80]!r}")
    return number
