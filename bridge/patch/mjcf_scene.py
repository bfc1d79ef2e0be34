"""A user's MJCF being edited: its MjSpec, the original compiled model, and its XML.

MjSpec can neither insert a body between two others nor write more than six digits, so both are
done in the text that it writes.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from gapbridge.bridge.patch.changes import Axes
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError
from gapbridge.core.files import require_utf8
from gapbridge.core.rotation import transform

ARMATURE = 1e-3  # kg m2 of an added joint, which MuJoCo needs to integrate stiff springs
DAMPING = 0.3  # damping ratio of an added joint
FOLDERS = ("meshdir", "texturedir")  # of <compiler>; MuJoCo writes assetdir as both
PLACED = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")
WRAPPER_MASS = 1e-6  # kg: MuJoCo requires more than zero of a moving body
SOLREF = (0.004, 1.0)  # of play and of the friction across it
POSES = 64  # in which a joint's inertia is computed


@dataclass(frozen=True)
class Hinge:
    """An added joint; point and axis in the frame of the body that it carries."""

    name: str
    point: Array  # (3,) m
    axis: Array  # (3,) unit vector
    stiffness: tuple[float, ...] = ()  # Nm/rad, Nm/rad2, ...: a polynomial in the angle
    inertia: float = 0.0  # kg m2 carried by the spring, for its damping
    half_range: float = 0.0  # rad to each side, 0 where it is not limited
    softness: float = 1.0  # how much softer the limits are than MuJoCo's own

    def element(self, timestep: float) -> ElementTree.Element:
        """Return the <joint> with every attribute, which the model's defaults could override.

        A spring that is too stiff for the time step gets the damping that its integration needs.
        """
        stiffness = self.stiffness or (0.0,)
        damping = max(2 * DAMPING * np.sqrt(self.inertia * stiffness[0]), timestep * stiffness[0])
        half = self.half_range
        joint = ElementTree.Element(
            "joint", name=self.name, type="hinge", pos=numbers(self.point),
            axis=numbers(self.axis), stiffness=numbers(stiffness), damping=numbers(damping),
            armature=numbers(ARMATURE), frictionloss="0", ref="0", springref="0", margin="0",
            limited="true" if half else "false", actuatorfrclimited="false",
        )  # fmt: skip
        if half:
            joint.set("range", numbers([-half, half]))
            joint.set("solreflimit", numbers(SOLREF))
            joint.set("solimplimit", numbers(impedance(self.softness)))
        return joint


def impedance(softness: float) -> tuple[float, ...]:
    """Return MuJoCo's solimp, its default where ``softness`` is 1."""
    return 1 - 0.1 * softness, 1 - 0.05 * softness, 1e-3, 0.5, 2.0


class Scene:
    """A model with joints at angle zero; frames in world are those of the original."""

    def __init__(self, path: Path) -> None:
        """Read and compile a file. Raises InputError where MuJoCo is missing or refuses it."""
        try:
            import mujoco
        except ImportError:
            raise InputError(
                f"{path}: found an MJCF model, expected MuJoCo to be installed: "
                "pip install 'gapbridge[mujoco]'"
            ) from None
        require_utf8(path)
        self.path = path
        self.mujoco = mujoco
        # MuJoCo's own handler writes MUJOCO_LOG.TXT into the folder in which the user is
        warnings: list[str] = []
        mujoco.set_mju_user_warning(warnings.append)
        try:
            self.spec: Any = mujoco.MjSpec.from_file(str(path))
            self._name_bodies()
            self.compiled: Any = self.spec.compile()
        except (ValueError, OSError) as error:
            text = " ".join(str(error).split())
            raise InputError(f"{path}: found no MJCF that compiles ({text})") from None
        finally:
            mujoco.set_mju_user_warning(None)
        self._require_finite(warnings)
        self.data: Any = mujoco.MjData(self.compiled)
        for j in range(self.compiled.njnt):  # angle zero, whatever the joint's ref
            self.data.qpos[self.compiled.jnt_qposadr[j]] = 0
        mujoco.mj_kinematics(self.compiled, self.data)
        mujoco.mj_comPos(self.compiled, self.data)
        self._placed: dict[tuple[str, str], Array] = {}  # tag and name -> frame in its parent's
        self._after: dict[str, list[Hinge]] = {}  # by joint
        self._before: dict[str, tuple[str, list[Hinge]]] = {}  # by body: the body inserted before
        self._explicit: set[int] = set()  # ids of bodies
        self._tendons: list[tuple[str, str, float, float]] = []

    def _require_finite(self, warnings: Sequence[str]) -> None:
        """Raise InputError for a NaN in the file, or a body that is at no place."""
        for body, placed in enumerate(np.isfinite(self.compiled.body_pos).all(axis=1)):
            if not placed:
                name = self.compiled.body(body).name
                found = " ".join(f"{x:g}" for x in self.compiled.body_pos[body])
                raise InputError(
                    f"{self.path}: body {name!r}: pos: found {found}, expected finite numbers"
                )
        if nans := [text for text in warnings if "NaN" in text]:
            raise InputError(f"{self.path}: found NaN, expected finite numbers ({nans[0]})")

    def _name_bodies(self) -> None:
        """Name the bodies of named joints, to be found in the XML; others can stay unnamed."""
        for joint in self.spec.joints:
            if joint.name:
                self._name(joint.parent, f"{joint.name}_body")

    def _name(self, body: Any, name: str) -> str:
        """Return a body's name; one that has none gets ``name``, or that with more at its end."""
        taken = {other.name for other in self.spec.bodies}
        while not body.name:
            if name not in taken:
                body.name = name
            name += "_"
        return str(body.name)

    def hinges(self) -> list[str]:
        """Return the names of all hinges that have one."""
        hinge = self.mujoco.mjtJoint.mjJNT_HINGE
        return [j.name for j in self.spec.joints if j.type == hinge and j.name]

    def axes(self, names: Sequence[str]) -> Axes:
        """Return the lines of joints' axes in world."""
        ids = [self.compiled.joint(name).id for name in names]
        return Axes(self.data.xanchor[ids].copy(), self.data.xaxis[ids].copy())

    def body_of(self, joint: str) -> Any:
        """Return a joint's body."""
        return self.spec.joint(joint).parent

    def in_body(self, body: Any, vector: Array) -> Array:
        """Return a vector (3,) of world in a body's axes."""
        return np.asarray(self.frame(body)[:3, :3].T @ vector)

    def point_in(self, body: Any, point: Array) -> Array:
        """Return a point (3,) of world in a body's frame."""
        frame = self.frame(body)
        return np.asarray(frame[:3, :3].T @ (point - frame[:3, 3]))

    def frame(self, body: Any) -> Array:
        """Return a body's frame (4, 4) in world."""
        return transform(self.data.xmat[body.id].reshape(3, 3), self.data.xpos[body.id])

    def move(self, body: Any, motion: Array) -> None:
        """Move a body and all that follow by a motion (4, 4) in world."""
        parent = self.frame(body.parent)
        local = np.linalg.inv(parent) @ motion @ self.frame(body)
        self.place("body", body, local @ self._written_in_frame(body))

    def _written_in_frame(self, body: Any) -> Array:
        """Return the frame (4, 4) that the file gives a body, its joints at ref, in its own here.

        Angle zero is not where the file has a body whose joint has a ref.
        """
        local = np.linalg.inv(self.frame(body.parent)) @ self.frame(body)
        w, x, y, z = self.compiled.body_quat[body.id]
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        return np.asarray(np.linalg.inv(local) @ transform(turn, self.compiled.body_pos[body.id]))

    def place(self, tag: str, element: Any, in_parent: Array) -> None:
        """Set the frame (4, 4) of a body or site in its parent body's, when it is written."""
        self._placed[tag, element.name] = in_parent

    def inertial(self, body: Any) -> Any:
        """Return a body with explicit mass, centre of gravity and inertia, to be changed."""
        if body.id not in self._explicit:
            compiled = self.compiled.body(body.id)
            body.explicitinertial = True
            body.mass = float(compiled.mass[0])
            body.ipos, body.iquat = compiled.ipos, compiled.iquat
            body.inertia, body.fullinertia = compiled.inertia, np.full(6, np.nan)
            body.ialt.type = self.mujoco.mjtOrientation.mjORIENTATION_QUAT
            self._explicit.add(body.id)
        return body

    def make_inertials_explicit(self) -> list[str]:
        """Give all bodies their masses and inertias where compiler options would change them.

        Returns the names of the options, which are then off: they ignore or scale what a patch
        writes into a body.
        """
        kinds = self.mujoco.mjtInertiaFromGeom
        options = []
        if self.spec.compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_TRUE:
            options.append("inertiafromgeom")
        if self.spec.compiler.settotalmass > 0:
            options.append("settotalmass")
        if options:
            for body in self.spec.bodies[1:]:
                self.inertial(body)
            self.spec.compiler.inertiafromgeom = kinds.mjINERTIAFROMGEOM_AUTO
            self.spec.compiler.settotalmass = -1
        return options

    def fixed_to(self, body: Any, without: str | None = None) -> list[Any]:
        """Return a body and all that are fixed to it, which have no joints of their own.

        ``without``: the name of a body that is left out, with those on it.
        """
        found = [body]
        for child in body.bodies:
            if not child.joints and child.name != without:
                found += self.fixed_to(child, without)
        return found

    def mass(self, body: Any) -> float:
        """Return a body's mass (kg) in the original."""
        return float(self.compiled.body_mass[body.id])

    def inertia_about(self, joint: str, axis: Array, anchor: Array | None = None) -> float:
        """Return the inertia (kg m2) of all bodies from a joint on, about an axis in world."""
        j = self.compiled.joint(joint).id
        anchor = self.data.xanchor[j] if anchor is None else anchor
        return self._inertia(self.data, j, axis, anchor)

    def largest_inertia(self, joint: str) -> float:
        """Return the largest inertia (kg m2) of all bodies from a joint on about its axis."""
        j = self.compiled.joint(joint).id
        addresses = [self.compiled.joint(name).qposadr[0] for name in self.hinges()]
        data = self.mujoco.MjData(self.compiled)
        inertias = []
        for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (POSES, len(addresses))):
            data.qpos[addresses] = q
            self.mujoco.mj_kinematics(self.compiled, data)
            inertias.append(self._inertia(data, j, data.xaxis[j], data.xanchor[j]))
        return max(inertias)

    def _inertia(self, data: Any, joint: int, axis: Array, anchor: Array) -> float:
        body = self.compiled.jnt_bodyid[joint]
        total = 0.0
        for k in range(body, self.compiled.nbody):
            ancestor = k
            while ancestor > body:
                ancestor = self.compiled.body_parentid[ancestor]
            if ancestor == body:
                lever = np.cross(axis, data.xipos[k] - anchor)
                total += self.compiled.body_mass[k] * float(lever @ lever)
        return total + ARMATURE

    def add_hinge_after(self, joint: str, hinge: Hinge) -> None:
        """Add a hinge after a joint and the hinges added there before, in the joint's body."""
        self._require_new("joint", hinge.name)
        self._after.setdefault(joint, []).append(hinge)

    def add_friction_tendon(self, joint: str, added: str, friction: float, softness: float) -> None:
        """Add a tendon over a joint and an added one, with ``friction`` (Nm) across both."""
        self._tendons.append((joint, added, friction, softness))

    def insert_body_before(self, body: Any, name: str, hinges: Sequence[Hinge]) -> None:
        """Insert a body with hinges, given in the frame of a body, between it and its parent."""
        in_written = np.linalg.inv(self._written_in_frame(body))  # which the inserted body gets
        turn, shift = in_written[:3, :3], in_written[:3, 3]
        placed = [replace(h, point=turn @ h.point + shift, axis=turn @ h.axis) for h in hinges]
        for hinge in hinges:
            self._require_new("joint", hinge.name)
        if body.name not in self._before:
            self._require_new("body", name)
            self._keep_apart(body)
        self._before[body.name] = (name, [*self._before.get(body.name, (name, []))[1], *placed])

    def _require_new(self, kind: str, name: str) -> None:
        """Raise InputError where the model has a joint or body of a name that is to be added."""
        if getattr(self.spec, kind)(name) is not None:
            raise InputError(
                f"{self.path}: {kind}: found {name!r} already, expected the model without it: that "
                "is what the patch adds"
            )

    def _keep_apart(self, body: Any) -> None:
        """Exclude the contacts that MuJoCo itself leaves out while a body is its parent's child."""
        weld = self.compiled.body_weldid
        parent = weld[self.compiled.body_parentid[body.id]]
        unfiltered = self.mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
        if parent == 0 or self.compiled.opt.disableflags & unfiltered:
            return  # there are contacts already, as with all that stands still
        for one in self._solid(parent):
            for other in self._solid(body.id):
                self.spec.add_exclude(bodyname1=one, bodyname2=other)

    def _solid(self, weld: int) -> list[str]:
        """Return the names of a body and those fixed to it that have geoms."""
        fixed = (self.compiled.body_weldid == weld) & (self.compiled.body_geomnum > 0)
        return [self._name(self.spec.bodies[k], f"body_{k}") for k in np.flatnonzero(fixed)]

    @property
    def added_joints(self) -> int:
        """Return the number of added joints."""
        return sum(map(len, self._after.values())) + sum(len(h) for _, h in self._before.values())

    def _keyframes(self, root: ElementTree.Element, patched: Any) -> None:
        """Rewrite keyframes: added joints at zero, added filters of actuators at their control."""
        for key, element in zip(self.spec.keys, root.iterfind("./keyframe/key"), strict=True):
            for name, size in (
                ("qpos", {0: 7, 1: 4, 2: 1, 3: 1}),
                ("qvel", {0: 6, 1: 3, 2: 1, 3: 1}),
            ):
                values = np.array(getattr(key, name))
                if len(values) and self.added_joints:
                    element.set(name, numbers(self._with_added_joints(values, size)))
            if patched.na > self.compiled.na:
                element.set("act", numbers(self._activations(key, patched)))

    def _with_added_joints(self, values: Array, size: dict[int, int]) -> Array:
        """Return a keyframe's numbers with zeros for added joints; ``size``: of a type of joint."""
        parts: list[Array] = []
        begin = 0
        for j in range(self.compiled.njnt):
            joint = self.compiled.joint(j)
            body = self.compiled.body(joint.bodyid[0])
            if j == body.jntadr[0]:
                parts.append(np.zeros(len(self._before.get(body.name, ("", []))[1])))
            end = begin + size[int(joint.type[0])]
            parts.append(values[begin:end])
            parts.append(np.zeros(len(self._after.get(joint.name, []))))
            begin = end
        return np.concatenate(parts)

    def _activations(self, key: Any, patched: Any) -> Array:
        """Return the activations of a keyframe in the patched model."""
        act, control = np.array(key.act), np.array(key.ctrl)
        given = act if len(act) else np.zeros(self.compiled.na)
        values = np.zeros(patched.na)
        for i in range(patched.nu):
            new, count = patched.actuator_actadr[i], patched.actuator_actnum[i]
            old = self.compiled.actuator_actadr[i]
            if old >= 0:
                values[new : new + count] = given[old : old + count]
            elif count and len(control):
                values[new] = control[i]
        return values

    def text(self, comment: Sequence[str], folder: Path | None) -> str:
        """Return the changed model as XML, its paths relative to ``folder``."""
        self.spec.comment = ""
        try:
            patched = self.spec.compile()
        except ValueError as error:  # such as of a link that an effect leaves without mass
            reason = " ".join(str(error).split())
            raise InputError(
                f"{self.path}: with the cell's effects the model does not compile ({reason})"
            ) from None
        root = ElementTree.fromstring(self.spec.to_xml())
        timestep = float(self.spec.option.timestep)
        text = "\n".join(comment).replace("--", "- -")
        root.insert(0, ElementTree.Comment(f" {text} "))
        for joint, hinges in self._after.items():
            body, child = _in_body(root, _named(root, "joint", joint))
            index = list(body).index(child) + 1
            for k, hinge in enumerate(hinges):
                body.insert(index + k, hinge.element(timestep))
        for name, (wrapper, hinges) in self._before.items():
            _write_body_before(root, name, wrapper, [hinge.element(timestep) for hinge in hinges])
        for (tag, name), frame in self._placed.items():
            carrier = self._before[name][0] if tag == "body" and name in self._before else name
            _write_frame(root, tag, carrier, frame)
        for tendon in self._tendons:
            _write_tendon(root, *tendon)
        self._keyframes(root, patched)
        if folder is not None and folder.resolve() != self.path.parent.resolve():
            _rebase(root, self.path.parent.resolve(), folder.resolve())
        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="unicode") + "\n"


def numbers(values: Any) -> str:
    """Return numbers as an attribute's text, with all digits."""
    return " ".join(f"{v:.17g}" for v in np.atleast_1d(values))


def _named(root: ElementTree.Element, tag: str, name: str) -> ElementTree.Element:
    return next(e for e in root.iter(tag) if e.get("name") == name)


def _in_body(
    root: ElementTree.Element, element: ElementTree.Element
) -> tuple[ElementTree.Element, ElementTree.Element]:
    """Return the body that an element is in, and its child with the element in it."""
    parents = {child: parent for parent in root.iter() for child in parent}
    while parents[element].tag == "frame":
        element = parents[element]
    return parents[element], element


def _write_frame(root: ElementTree.Element, tag: str, name: str, in_body: Array) -> None:
    """Write the frame (4, 4) of a body or site in its parent body's: position and quaternion."""
    element = _named(root, tag, name)
    parents = {child: parent for parent in root.iter() for child in parent}
    parent, inverse = parents[element], np.eye(4)
    while parent.tag == "frame":
        inverse = inverse @ np.linalg.inv(_frame_of(parent))
        parent = parents[parent]
    frame = inverse @ in_body
    for key in PLACED:
        element.attrib.pop(key, None)
    quat = Rotation.from_matrix(frame[:3, :3]).as_quat()[[3, 0, 1, 2]]
    element.set("pos", numbers(frame[:3, 3]))
    element.set("quat", numbers(quat))


def _frame_of(element: ElementTree.Element) -> Array:
    """Return the frame (4, 4) of an element as MuJoCo's writer has it: pos and quat."""
    quat = np.array(element.get("quat", "1 0 0 0").split(), dtype=float)
    pos = np.array(element.get("pos", "0 0 0").split(), dtype=float)
    return transform(Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix(), pos)


def _write_body_before(
    root: ElementTree.Element, name: str, wrapper: str, hinges: Sequence[ElementTree.Element]
) -> None:
    body = _named(root, "body", name)
    parent = next(e for e in root.iter() if body in list(e))
    inserted = ElementTree.Element("body", name=wrapper)
    for key in (*PLACED, "childclass"):
        if key in body.attrib:
            inserted.set(key, body.attrib[key])
            if key in PLACED:
                del body.attrib[key]
    point = np.array(hinges[0].attrib["pos"].split(), dtype=float)
    inertial = {"pos": point, "mass": WRAPPER_MASS, "diaginertia": [WRAPPER_MASS] * 3}
    ElementTree.SubElement(inserted, "inertial", {k: numbers(v) for k, v in inertial.items()})
    inserted.extend(hinges)
    index = list(parent).index(body)
    parent.remove(body)
    inserted.append(body)
    parent.insert(index, inserted)


def _write_tendon(
    root: ElementTree.Element, joint: str, added: str, friction: float, softness: float
) -> None:
    tendons = root.find("tendon")
    if tendons is None:
        tendons = ElementTree.SubElement(root, "tendon")
    fixed = ElementTree.SubElement(
        tendons, "fixed", name=f"{added}_friction", frictionloss=numbers(friction),
        limited="false", stiffness="0", damping="0", solreffriction=numbers(SOLREF),
        solimpfriction=numbers(impedance(softness)),
    )  # fmt: skip
    for name in (joint, added):
        ElementTree.SubElement(fixed, "joint", joint=name, coef="1")


def _rebase(root: ElementTree.Element, old: Path, new: Path) -> None:
    """Write the folders of meshes and textures relative to another folder.

    Both, whether the model has them or not: it may have files of either kind.
    """
    if not any(key.startswith("file") for e in root.iter() for key in e.attrib):
        return
    compiler = root.find("compiler")
    if compiler is None:
        compiler = ElementTree.Element("compiler")
        root.insert(0, compiler)
    for key in FOLDERS:
        folder = Path(compiler.get(key, ""))
        if not folder.is_absolute():
            compiler.set(key, os.path.relpath(old / folder, new))
