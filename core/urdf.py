"""Arms from URDF files: the chain of revolute joints from the root to the tip link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gapbridge.core.arm import Arm, JointLimits
from gapbridge.core.arrays import Array
from gapbridge.core.errors import ArmError, first_line
from gapbridge.core.files import read_text
from gapbridge.core.rotation import rotation_matrix, rpy_matrix, transform

REVOLUTE = ("revolute", "continuous")
XACRO = "ros.org/wiki/xacro"  # in the namespace of its macros


@dataclass(frozen=True)
class _Body:
    """Mass properties of the bodies fixed to one moving link, in that link's frame."""

    mass: float
    first: Array  # kg m, first moment of mass
    second: Array  # kg m2, inertia about the frame's origin

    def __add__(self, other: _Body) -> _Body:
        return _Body(
            self.mass + other.mass, self.first + other.first, self.second + other.second
        )  # fmt: skip


NO_BODY = _Body(0.0, np.zeros(3), np.zeros((3, 3)))


@np.errstate(all="ignore")  # what overflows is refused as implausible, without numpy's warnings
def arm_from_urdf(path: Path | str, tip: str | None = None) -> Arm:
    """Return the arm of a URDF file, from its root link to ``tip`` (default: the last link).

    Fixed joints are merged into their parent links; side branches (grippers, covers) add their
    masses to the link that they are on. Joint frames are rotated so that z is the axis.
    Raises ArmError where the file is not a URDF, the tip is unknown or ambiguous, or a joint on the
    way is neither revolute, continuous nor fixed.
    """
    path = Path(path)
    robot = _parse(path)
    joints = {_child(j): j for j in robot.findall("joint")}
    links = {str(link.get("name")): link for link in robot.findall("link")}
    tip = tip or _only_leaf(path, links, joints)
    if tip not in links:
        raise ArmError(
            f"{path}: robot.tip: found {tip!r}, expected a link of the file: {', '.join(links)}"
        )
    chain = _chain(tip, joints)
    return _assemble(path, str(robot.get("name", path.stem)), chain, joints, links)


def _parse(path: Path) -> ElementTree.Element:
    try:
        return checked_urdf(path, read_text(path))
    except FileNotFoundError:
        raise ArmError(f"{path}: robot.urdf: file not found") from None
    except UnicodeDecodeError:
        raise ArmError(f"{path}: found bytes that are no text, expected a URDF (UTF-8)") from None
    except OSError as error:
        raise ArmError(f"{path}: robot.urdf: cannot be read: {first_line(error)}") from None


def checked_urdf(path: Path, text: str) -> ElementTree.Element:
    """Return the root of a URDF whose links and joints are a tree; ``path`` is for messages.

    Raises ArmError for broken XML, for what is no URDF, and where names or links contradict each
    other.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ArmError(f"{path}: found broken XML ({error}), expected a URDF") from None
    if root.tag != "robot":
        raise ArmError(f"{path}: found a <{root.tag}> file, expected a URDF <robot>")
    if any(XACRO in element.tag for element in root.iter()):
        raise ArmError(
            f"{path}: found xacro macros, expected a plain URDF (ros2 run xacro xacro {path.name} "
            "-o robot.urdf)"
        )
    for kind in ("link", "joint"):
        names = [str(element.get("name")) for element in root.findall(kind)]
        if twice := next((name for i, name in enumerate(names) if name in names[:i]), None):
            raise ArmError(f"{path}: {kind} {twice!r}: found twice, expected once")
    links = {str(link.get("name")) for link in root.findall("link")}
    if not links:
        raise ArmError(f"{path}: found no links, expected those of an arm")
    moved_by: dict[str, str | None] = {}  # by the joint that turns or holds it
    for joint in root.findall("joint"):
        label = f"{path}: joint {joint.get('name')!r}"
        if joint.find("child") is None or joint.find("parent") is None:
            raise ArmError(f"{label}: found no parent or child link")
        for link in (_parent(joint), _child(joint)):
            if link not in links:
                raise ArmError(f"{label}: found link {link!r}, expected one that the file has")
        if _child(joint) in moved_by:
            raise ArmError(
                f"{label}: found child link {_child(joint)!r}, expected one that joint "
                f"{moved_by[_child(joint)]!r} does not move already"
            )
        moved_by[_child(joint)] = joint.get("name")
    _require_tree(path, {_child(joint): _parent(joint) for joint in root.findall("joint")})
    return root


def _require_tree(path: Path, parents: dict[str, str]) -> None:
    """Raise ArmError for links in a closed loop; ``parents``: each link's, by its name."""
    held: set[str] = set()  # by a root
    for link in parents:
        above: set[str] = set()
        while link in parents and link not in held:
            if link in above:
                raise ArmError(f"{path}: link {link!r}: found a closed loop, expected a tree")
            above.add(link)
            link = parents[link]
        held |= above


def _only_leaf(
    path: Path, links: dict[str, ElementTree.Element], joints: dict[str, ElementTree.Element]
) -> str:
    parents = {_parent(j) for j in joints.values()}
    leaves = [name for name in links if name not in parents]
    if len(leaves) == 1:
        return leaves[0]
    depth = {leaf: sum(j.get("type") in REVOLUTE for j in _chain(leaf, joints)) for leaf in leaves}
    deepest = [leaf for leaf in leaves if depth[leaf] == max(depth.values())]
    if len(deepest) == 1:
        return deepest[0]
    raise ArmError(
        f"{path}: robot.tip: found {len(leaves)} ends ({', '.join(leaves)}), expected robot.tip to "
        "name the flange link"
    )


def _parent(joint: ElementTree.Element) -> str:
    parent = joint.find("parent")
    return "" if parent is None else str(parent.get("link"))


def _chain(tip: str, joints: dict[str, ElementTree.Element]) -> list[ElementTree.Element]:
    chain: list[ElementTree.Element] = []
    link = tip
    while link in joints and joints[link] not in chain:
        chain.append(joints[link])
        link = _parent(joints[link])
    return chain[::-1]


def _assemble(
    path: Path,
    name: str,
    chain: list[ElementTree.Element],
    joints: dict[str, ElementTree.Element],
    links: dict[str, ElementTree.Element],
) -> Arm:
    fixed, bodies, moving = [np.eye(4)], [NO_BODY], []
    on_chain = {_child(j) for j in chain}
    root = _parent(chain[0]) if chain else ""
    bodies[-1] += _branches(path, root, np.eye(4), joints, links, on_chain)
    for joint in chain:
        kind, label = joint.get("type"), f"{path}: joint {joint.get('name')!r}"
        step = fixed[-1] @ origin_of(joint, label)
        if kind in REVOLUTE:
            align = _align_z(axis_of(joint, label))
            fixed[-1] = step @ align
            moving.append(joint)
            fixed.append(align.T)  # align is a pure rotation
            bodies.append(NO_BODY)
        elif kind == "fixed":
            fixed[-1] = step
        else:
            raise ArmError(f"{label}: found type {kind!r}, expected revolute, continuous or fixed")
        bodies[-1] += _link(path, links[_child(joint)], fixed[-1])
        bodies[-1] += _branches(path, _child(joint), fixed[-1], joints, links, on_chain)
    if not moving:
        raise ArmError(f"{path}: found no revolute joint on the way to the tip")
    return _arm(path, name, np.array(fixed), bodies[1:], moving)


def _arm(
    path: Path, name: str, fixed: Array, bodies: list[_Body], moving: list[ElementTree.Element]
) -> Arm:
    mass = np.array([b.mass for b in bodies])
    cog = np.array([b.first / b.mass if b.mass > 0 else np.zeros(3) for b in bodies])
    inertia = np.array([b.second - b.mass * _point(c) for b, c in zip(bodies, cog, strict=True)])
    columns: dict[str, list[float]] = {"lower": [], "upper": [], "velocity": [], "effort": []}
    for joint in moving:
        limit = joint.find("limit")
        label = f"{path}: joint {joint.get('name')!r}: limit"
        free = joint.get("type") == "continuous"
        for key, default in (("lower", -np.inf), ("upper", np.inf)):
            declared = limit is not None and not free and limit.get(key) is not None
            columns[key].append(numbers_of(limit, key, "0", label)[0] if declared else default)
        for key in ("velocity", "effort"):
            value = _not_negative(limit, key, label)
            columns[key].append(value if value > 0 else np.inf)
    limits = JointLimits(**{key: np.array(values) for key, values in columns.items()})
    names = tuple(str(j.get("name")) for j in moving)
    axes = np.array([_align_z(axis_of(joint, f"{path}: joint")).T[:3, :3] for joint in moving])
    return Arm(name, fixed, mass, cog, inertia, limits, joint_names=names, body_axes=axes)


def _child(joint: ElementTree.Element) -> str:
    child = joint.find("child")
    return "" if child is None else str(child.get("link"))


def _branches(
    path: Path, link: str, frame: Array,
    joints: dict[str, ElementTree.Element], links: dict[str, ElementTree.Element],
    on_chain: set[str],
) -> _Body:  # fmt: skip
    """Return the mass properties of a link's side branches."""
    body = NO_BODY
    for child, joint in joints.items():
        if _parent(joint) != link or child in on_chain:
            continue
        # movable side joints (a gripper's fingers) are taken at zero
        child_frame = frame @ origin_of(joint, f"{path}: joint {joint.get('name')!r}")
        body += _link(path, links[child], child_frame)
        body += _branches(path, child, child_frame, joints, links, on_chain)
    return body


def _link(path: Path, link: ElementTree.Element, frame: Array) -> _Body:
    """Return the mass properties of one link, in the frame's axes."""
    inertial = link.find("inertial")
    if inertial is None:
        return NO_BODY
    label = f"{path}: link {link.get('name')!r}"
    element = inertial.find("mass")
    mass = numbers_of(element, "value", "0", label)[0]
    pose = frame @ origin_of(inertial, label)
    tensor = inertial.find("inertia")
    about_centre = np.zeros((3, 3))
    if tensor is not None:
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            key = "i" + "xyz"[i] + "xyz"[j]
            number = _not_negative(tensor, key, label) if i == j else (
                numbers_of(tensor, key, "0", label)[0]
            )  # fmt: skip
            about_centre[i, j] = about_centre[j, i] = number
    R, c = pose[:3, :3], pose[:3, 3]
    return _Body(mass, mass * c, R @ about_centre @ R.T + mass * _point(c))


def _point(c: Array) -> Array:
    """Return the inertia (3, 3) of a unit point mass at c about the origin."""
    return np.asarray(c @ c * np.eye(3) - np.outer(c, c))


def axis_of(joint: ElementTree.Element, label: str) -> Array:
    """Return a joint's axis (3,) as it stands; raises ArmError, its message after ``label``."""
    axis = numbers_of(joint.find("axis"), "xyz", "1 0 0", label)
    if not 1e-6 <= math.hypot(*axis) <= 1e6:
        found = " ".join(f"{v:g}" for v in axis)
        raise ArmError(f"{label}: axis xyz: found {found!r}, expected a direction")
    return axis


def origin_of(element: ElementTree.Element, label: str) -> Array:
    """Return the frame (4, 4) of an element's origin, m; raises ArmError as ``axis_of`` does."""
    origin = element.find("origin")
    xyz = numbers_of(origin, "xyz", "0 0 0", label)
    return transform(rpy_matrix(numbers_of(origin, "rpy", "0 0 0", label)), xyz)


def numbers_of(element: ElementTree.Element | None, key: str, default: str, label: str) -> Array:
    """Return the finite numbers of an attribute, as many as ``default`` has, which it may lack.

    Raises ArmError as ``axis_of`` does.
    """
    text = default if element is None else str(element.get(key, default))
    try:
        if "_" in text:  # Python reads 1_0 as 10
            raise ValueError
        values = np.array([float(v) for v in text.split()])
    except ValueError:
        values = np.array([])
    if len(values) != len(default.split()) or not np.isfinite(values).all():
        raise ArmError(
            f"{label}: {key}: found {text!r}, expected {len(default.split())} finite number(s)"
        )
    return values


def _not_negative(element: ElementTree.Element | None, key: str, label: str) -> float:
    """Return a number of 0 or more; 0 where it is left out."""
    value = float(numbers_of(element, key, "0", label)[0])
    if value < 0.0:
        raise ArmError(f"{label}: {key}: found {value:g}, expected 0 or more")
    return value


def _align_z(axis: Array) -> Array:
    """Return a rotation (4, 4) whose z axis is ``axis``, by the shortest turn from z."""
    z = axis / np.linalg.norm(axis)
    cross = np.cross([0, 0, 1.0], z)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-12:
        turn = np.eye(3) if z[2] > 0 else np.diag([1.0, -1.0, -1.0])
    else:
        turn = rotation_matrix(cross / sine * np.arctan2(sine, z[2]))
    return transform(turn, np.zeros(3))
