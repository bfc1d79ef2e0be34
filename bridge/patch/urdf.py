"""URDF: origins, inertials, friction and damping; only attributes that change are rewritten."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape, unescape

import numpy as np

from gapbridge.bridge.patch.changes import TOLERANCE, Axes, ModelChanges, base_in_world
from gapbridge.bridge.patch.model_format import (
    MARK,
    ModelFormat,
    Patched,
    PatchOptions,
    known_name,
    pick_joints,
)
from gapbridge.core.arrays import Array
from gapbridge.core.effects.simulator import Kind
from gapbridge.core.errors import InputError
from gapbridge.core.rotation import roll_pitch_yaw
from gapbridge.core.urdf import axis_of, checked_urdf, numbers_of, origin_of

REVOLUTE = ("revolute", "continuous")
FILES = re.compile(r"<(?:mesh|texture)\b[^>]*?\bfilename\s*=\s*([\"'])(.*?)\1", re.DOTALL)
QUOTES = {'"': "&quot;", "'": "&apos;"}
INSTEAD = {
    Kind.ARMATURE: "rotor inertia: set the armature where the simulator has it",
    Kind.DELAY: "delay: in the controller, or the simulator's actuator",
    Kind.LAG: "lag of the servo: in the controller, or the simulator's actuator",
    Kind.SERVO_COMPLIANCE: "gain of the servo: in the controller's settings",
    Kind.PLAY: "play: SDF or MJCF with a second, limited joint",
    Kind.PAYLOAD: "load: change the inertial of the link that carries it",
    Kind.PAYLOAD_COG: "load: move the centre of the inertial of the link that carries it",
    Kind.SENSOR_TURN: "sensor's frame: turn the fixed joint of its link, or its readings",
}


class Urdf(ModelFormat):
    """The Unified Robot Description Format."""

    suffixes = (".urdf",)
    text_suffixes = suffixes

    def patch(self, path: Path, changes: ModelChanges, options: PatchOptions,
              notes: Sequence[str]) -> Patched:  # fmt: skip
        """Return the URDF with changed attributes; order and comments are kept."""
        document = _Document(path)
        names = pick_joints(path, document.revolute_joints(), changes, options)
        frames = document.child_frames()
        world = base_in_world(changes.axes(), document.axes(names, frames), str(path), names)
        changed = []
        for i, name in enumerate(names):
            if not np.allclose(changes.shift[i], np.eye(4), rtol=0, atol=TOLERANCE):
                document.move(name, changes.motion(i, world), frames)
                changed.append(f"joint {name}: origin")
            changed += _dynamics(document, name, changes, i + 1, options)
        inertials, without_mass = _inertials(document, names, changes, world, frames)
        changed += inertials
        missing = [*without_mass, *_tool(document, path, changes, options, world, frames, changed),
                   *_springs(changes), *_settings(changes)]  # fmt: skip
        document.rebase(options.folder or path.parent)
        document.comment([MARK, *changed, *notes,
                          *(f"not in this file: {line}" for line in missing)])  # fmt: skip
        return Patched(document.text, tuple(changed), tuple(missing))


class _Document:
    """A URDF as text, whose attributes are rewritten in place."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from None
        self.root = checked_urdf(path, self.text)
        self.joints = {str(j.get("name")): j for j in self.root.findall("joint")}
        self.links = {str(link.get("name")): link for link in self.root.findall("link")}

    def revolute_joints(self) -> list[str]:
        return [name for name, joint in self.joints.items() if joint.get("type") in REVOLUTE]

    def end(self, joint: str, tag: str) -> str:
        element = self.joints[joint].find(tag)
        return "" if element is None else str(element.get("link"))

    def origin(self, joint: str) -> Array:
        return origin_of(self.joints[joint], self.label(joint))

    def label(self, name: str, kind: str = "joint") -> str:
        """Return what messages call a joint or link."""
        return f"{self.path}: {kind} {name!r}"

    def child_frames(self) -> dict[str, Array]:
        """Return the frames (4, 4) of all links in the root link's, joints at zero."""
        parent_of = {self.end(name, "child"): name for name in self.joints}
        frames: dict[str, Array] = {}

        def frame(link: str) -> Array:
            if link not in frames:
                joint = parent_of.get(link)
                frames[link] = np.eye(4) if joint is None else (
                    frame(self.end(joint, "parent")) @ self.origin(joint)
                )  # fmt: skip
            return frames[link]

        for link in self.links:
            frame(link)
        return frames

    def axes(self, names: Sequence[str], frames: dict[str, Array]) -> Axes:
        point, direction = [], []
        for name in names:
            frame = frames[self.end(name, "child")]
            axis = axis_of(self.joints[name], self.label(name))
            point.append(frame[:3, 3])
            direction.append(frame[:3, :3] @ axis / np.linalg.norm(axis))
        return Axes(np.array(point), np.array(direction))

    def mass(self, link: str) -> float:
        """Return a link's mass (kg), 0 where it has none."""
        element = self.links[link].find("inertial/mass")
        return float(numbers_of(element, "value", "0", self.label(link, "link"))[0])

    def fixed_to(self, link: str) -> list[str]:
        """Return a link and all that are fixed to it."""
        found = [link]
        for name, joint in self.joints.items():
            if joint.get("type") == "fixed" and self.end(name, "parent") == link:
                found += self.fixed_to(self.end(name, "child"))
        return found

    def move(self, joint: str, motion: Array, frames: dict[str, Array]) -> None:
        """Move a joint's child and all that follow by a motion (4, 4) in the root's frame."""
        parent = frames[self.end(joint, "parent")]
        origin = np.linalg.inv(parent) @ motion @ parent @ self.origin(joint)
        self.write("joint", joint, "origin",
                   {"xyz": origin[:3, 3], "rpy": roll_pitch_yaw(origin[:3, :3])})  # fmt: skip

    def write(
        self, kind: str, name: str, tag: str, values: dict[str, Array | float], inside: str = ""
    ) -> None:
        """Rewrite attributes of <tag> in <kind name=...>; a missing element is added.

        ``inside``: the child element that contains <tag>; '': <tag> is a direct child.
        """
        with_type = r"(?=[^>]*\btype\s*=)" if kind == "joint" else ""  # no transmission's joint
        visible, written_name = _without_comments(self.text), re.escape(escape(name))
        block = re.search(
            rf"<{kind}\b{with_type}[^>]*\bname\s*=\s*([\"']){written_name}\1[^>]*>.*?</{kind}>",
            visible, re.DOTALL,
        )  # fmt: skip
        assert block is not None, f"{kind} {name}"
        begin, end = block.span()
        if inside:
            part = re.search(rf"<{inside}\b[^>]*>.*?</{inside}>", block[0], re.DOTALL)
            assert part is not None, f"{name}: {inside}"
            begin, end, kind = begin + part.start(), begin + part.end(), inside
        text = self.text[begin:end]
        numbers = {key: " ".join(f"{v:.17g}" for v in np.atleast_1d(value))
                   for key, value in values.items()}  # fmt: skip
        element = re.search(rf"<{tag}\b[^>]*?/?>", visible[begin:end])
        if element is None:
            attributes = " ".join(f'{key}="{value}"' for key, value in numbers.items())
            closing = f"</{kind}>"
            rewritten = f"{text.removesuffix(closing)}  <{tag} {attributes}/>\n  {closing}"
        else:
            old = written = element[0]
            for key, value in numbers.items():
                pattern = rf"(\b{key}\s*=\s*)([\"']).*?\2"
                if re.search(pattern, written):
                    written = re.sub(pattern, rf"\g<1>\g<2>{value}\g<2>", written, count=1)
                else:
                    written = re.sub(r"\s*(/?>)$", rf' {key}="{value}"\1', written)
            start = element.start()
            rewritten = text[:start] + written + text[start + len(old) :]
        self.text = self.text[:begin] + rewritten + self.text[end:]

    def rebase(self, folder: Path) -> None:
        """Write paths of meshes and textures, relative to the file's folder, for another folder."""
        old, new = self.path.parent.resolve(), folder.resolve()
        for found in reversed(list(FILES.finditer(_without_comments(self.text)))):
            name = unescape(found[2], {entity: sign for sign, entity in QUOTES.items()})
            if old == new or os.path.isabs(name) or not (old / name).is_file():
                continue  # also package://, which the simulator resolves
            moved = escape(os.path.relpath(old / name, new), QUOTES)
            self.text = self.text[: found.start(2)] + moved + self.text[found.end(2) :]

    def comment(self, lines: Sequence[str]) -> None:
        """Insert lines as a comment at the start of <robot>."""
        text = "\n       ".join(line.replace("--", "- -") for line in lines)
        robot = re.search(r"<robot\b[^>]*>", _without_comments(self.text))
        assert robot is not None
        self.text = f"{self.text[: robot.end()]}\n  <!-- {text} -->{self.text[robot.end() :]}"


def _without_comments(text: str) -> str:
    """Return the text with comments replaced by blanks, so that offsets are kept."""
    return re.sub(r"<!--.*?-->", lambda comment: " " * len(comment[0]), text, flags=re.DOTALL)


def _dynamics(
    document: _Document, name: str, changes: ModelChanges, joint: int, options: PatchOptions
) -> list[str]:
    element = document.joints[name].find("dynamics")
    values: dict[str, Array | float] = {}
    for kind, key in ((Kind.FRICTION, "friction"), (Kind.DAMPING, "damping")):
        added = changes.of_joint(kind, joint)
        if added:
            own = float(numbers_of(element, key, "0", document.label(name))[0])
            values[key] = options.total(added, own)
    if values:
        document.write("joint", name, "dynamics", values)
    return [f"joint {name}: {key} {value:.6g}" for key, value in values.items()]


def _inertials(
    document: _Document, names: Sequence[str], changes: ModelChanges, world: Array,
    frames: dict[str, Array],
) -> tuple[list[str], list[str]]:  # fmt: skip
    """Scale links' masses and inertias, and move their centres of gravity.

    A joint's link is its child and all that are fixed to it. Returns a line for each change, and
    one for each that finds no mass.
    """
    lines, missing = [], []
    for i, name in enumerate(names):
        scale = 1 + changes.of_joint(Kind.LINK_SCALE, i + 1)
        moment = changes.vector(Kind.LINK_MOMENT, i + 1)
        if scale == 1 and not moment.any():
            continue
        child = document.end(name, "child")
        masses = {link: document.mass(link) for link in document.fixed_to(child)}
        if not changes.is_one_link(i + 1, list(masses.values())):
            masses = {child: masses[child]}
        masses = {link: mass for link, mass in masses.items() if mass > 0}
        if not masses:
            missing.append(f"inertia of the link of {name}: {child} has no mass")
            continue
        if scale != 1:
            for link in masses:
                _scale(document, link, scale)
            lines.append(f"link {', '.join(masses)}: mass and inertia times {scale:.6g}")
        if moment.any():
            in_world = (world @ changes.joint_in_base[i])[:3, :3] @ moment
            shift = in_world / (sum(masses.values()) * scale)
            for link in masses:
                _shift_centre(document, link, frames[link][:3, :3].T @ shift)
            lines.append(f"link {', '.join(masses)}: centre of gravity")
    return lines, missing


def _scale(document: _Document, link: str, factor: float) -> None:
    """Scale a link's mass and inertia."""
    inertia = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    for tag, keys in (("mass", ("value",)), ("inertia", inertia)):
        element = document.links[link].find(f"inertial/{tag}")
        attributes = {} if element is None else element.attrib
        values: dict[str, Array | float] = {
            key: numbers_of(element, key, "0", document.label(link, "link")) * factor
            for key in keys if key in attributes
        }  # fmt: skip
        if values:
            document.write("link", link, tag, values)


def _shift_centre(document: _Document, link: str, shift: Array) -> None:
    """Move a link's centre of gravity by a vector (3,) in m, in its frame."""
    element = document.links[link].find("inertial/origin")
    centre = numbers_of(element, "xyz", "0 0 0", document.label(link, "link")) + shift
    document.write("link", link, "origin", {"xyz": centre}, inside="inertial")


def _tool(
    document: _Document, path: Path, changes: ModelChanges, options: PatchOptions, world: Array,
    frames: dict[str, Array], changed: list[str],
) -> list[str]:  # fmt: skip
    """Move the TCP's link; returns what the URDF cannot represent."""
    link = known_name(path, "--tcp", options.tcp, list(document.links))
    if np.allclose(changes.tcp_shift, np.eye(4), rtol=0, atol=TOLERANCE):
        return []
    if not link:
        return ["tool: name the fixed link of the TCP with --tcp"]
    joint = next((j for j in document.joints if document.end(j, "child") == link), None)
    if joint is None or document.joints[joint].get("type") != "fixed":
        raise InputError(f"{path}: --tcp: found {link}, expected a link behind a fixed joint")
    frame = world @ changes.tcp_in_base
    motion = frame @ changes.tcp_shift @ np.linalg.inv(frame)
    document.move(joint, motion, frames)
    changed.append(f"link {link}: TCP")
    return []


def _springs(changes: ModelChanges) -> list[str]:
    springs = changes.springs
    lines = []
    if springs.joint.any():
        lines.append("flexible joints: SDF or MJCF with springs on further joints")
    if springs.link.any():
        lines.append("flexible links: MJCF or SDF with springs across the links")
    if springs.base.any():
        lines.append("flexible base: MJCF or SDF with springs below the base")
    if changes.gravity is not None:
        lines.append("direction of gravity: in the simulator's world")
    return lines


def _settings(changes: ModelChanges) -> list[str]:
    kinds = {setting.kind for setting in changes.settings}
    lines = [text for kind, text in INSTEAD.items() if kind in kinds]
    lines += [f"{name}: {instead}" for name, instead in changes.unsupported]
    return [*lines, *changes.skipped]
