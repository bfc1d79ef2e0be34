"""USD: a stronger layer of ``over`` prims on the user's stage, which is not changed.

Attributes are those of UsdPhysics; where it has none, both PhysX's and Newton's are written. A
flexible joint or play is an added body of negligible mass with a joint before the joint's body.
Drives, limits and damping are per degree, armature and friction are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.patch.changes import TOLERANCE, ModelChanges, base_in_world
from gapbridge.bridge.patch.model_format import (
    MARK,
    ModelFormat,
    Patched,
    PatchOptions,
    known_name,
)
from gapbridge.bridge.patch.usd_stage import Stage
from gapbridge.core.arrays import Array
from gapbridge.core.effects.simulator import Kind
from gapbridge.core.errors import InputError
from gapbridge.core.rotation import transform

PER_DEGREE = np.pi / 180  # rad: factor from a drive's gain per rad to one per degree
SMALL = 1e-4  # kg, kg m2 of a body between two joints
INSTEAD = {
    Kind.LAG: "lag of the servo: in the controller, or a drive whose damping / stiffness is that",
    Kind.PAYLOAD: "load: change physics:mass of the prim that models it",
    Kind.PAYLOAD_COG: "load: move physics:centerOfMass of the prim that models it",
    Kind.SENSOR_TURN: "sensor's frame: turn the Xform of the sensor",
    Kind.LINK_MOMENT: "a link's centre of gravity: physics:centerOfMass, where its mass is known",
}


class Usd(ModelFormat):
    """Universal Scene Description, with UsdPhysics joints."""

    suffixes = (".usd", ".usda", ".usdc", ".usdz")
    text_suffixes = (".usda", ".usd")

    def patch(self, path: Path, changes: ModelChanges, options: PatchOptions,
              notes: Sequence[str]) -> Patched:  # fmt: skip
        """Return a layer (.usda) with the model as its sublayer and the changes as overs."""
        stage = Stage(path, options.folder)
        names = stage.pick_joints(changes, options)
        world = base_in_world(changes.axes(), stage.axes(names), str(path), names)
        layer = _Layer(stage, changes, options, world, names)
        for joint, name in enumerate(names, start=1):
            layer.frame(name, joint)
            layer.friction(name, joint)
            layer.drive(name, joint)
            layer.inertial(name, joint)
            layer.springs(name, joint)
        if layer.changed and not stage.move_bodies():
            layer.missing.append("rest pose of the bodies: the stage has the arm elsewhere than at "
                                "zero angles; simulators move them to the joints")  # fmt: skip
        layer.tool()
        layer.gravity()
        missing = layer.unsupported()
        comment = [MARK, *layer.changed, *notes,
                   *(f"not in this file: {line}" for line in missing)]  # fmt: skip
        return Patched(stage.text(comment), tuple(layer.changed), tuple(missing))


class _Layer:
    """Writes the changes into the stronger layer of a stage."""

    def __init__(self, stage: Stage, changes: ModelChanges, options: PatchOptions, world: Array,
                 names: Sequence[str]) -> None:  # fmt: skip
        self.stage, self.changes, self.options, self.world = stage, changes, options, world
        self.names = names
        self.changed: list[str] = []
        self.missing: list[str] = []

    def frame(self, name: str, joint: int) -> None:
        """Move a joint in its parent."""
        usd_joint = self.stage.joints[name]
        if not np.allclose(self.changes.shift[joint - 1], np.eye(4), rtol=0, atol=TOLERANCE):
            motion = self.changes.motion(joint - 1, self.world)
            parent = self.stage.frames[self.stage.body(usd_joint, 0)]
            local = np.linalg.inv(parent) @ motion @ self.stage.in_world(usd_joint)
            self.stage.set_local(usd_joint, 0, local)
            self.changed.append(f"joint {name}: physics:localPos0, localRot0")

    def friction(self, name: str, joint: int) -> None:
        """Set friction, damping and armature, as PhysX and as Newton name them."""
        prim = self.stage.joints[name].GetPrim()
        for kind, names in (
            (Kind.FRICTION, (("newton:friction", 1.0),
                             ("physxJointAxis:angular:dynamicFrictionEffort", 1.0),
                             ("physxJointAxis:angular:staticFrictionEffort", 1.0))),
            (Kind.DAMPING, (("newton:damping", PER_DEGREE),
                            ("physxJointAxis:angular:viscousFrictionCoefficient", PER_DEGREE))),
            (Kind.ARMATURE, (("newton:armature", 1.0),
                             ("physxJointAxis:angular:armature", 1.0))),
        ):  # fmt: skip
            added = self.changes.of_joint(kind, joint)
            if not added:
                continue
            for attribute, factor in names:
                found = added * factor / self._torque_unit()
                value = self.options.total(found, self._current(prim, attribute))
                self.stage.set(prim, attribute, "Float", value)
                self.changed.append(f"joint {name}: {attribute} {value:.6g}")

    def _current(self, prim: Any, attribute: str) -> float:
        value = prim.GetAttribute(attribute)
        return float(value.Get() or 0.0) if value else 0.0

    def _torque_unit(self) -> float:
        """Return the stage's unit of torque in Nm, and of inertia in kg m2."""
        return float(self.stage.kilogram * self.stage.unit**2)

    def drive(self, name: str, joint: int) -> None:
        """Set delay and gain of a joint's drive."""
        prim = self.stage.joints[name].GetPrim()
        delay = self.changes.of_joint(Kind.DELAY, joint)
        droop = self.changes.of_joint(Kind.SERVO_COMPLIANCE, joint)
        if delay:
            self.missing.append(f"delay of {name}, {delay:.6g} s: set it at the actuator in steps "
                                "(newton:delaySteps, DelayedPDActuatorCfg)")  # fmt: skip
        if not droop:
            return
        drive = self.stage.UsdPhysics.DriveAPI(prim, "angular")
        current = drive.GetStiffnessAttr().Get() if drive.GetStiffnessAttr() else None
        scale = PER_DEGREE / self._torque_unit()
        compliance = scale / float(current) if current and self.options.on_top else 0.0
        stiffness = scale / (droop + compliance)
        drive = self.stage.UsdPhysics.DriveAPI.Apply(prim, "angular")
        drive.CreateStiffnessAttr().Set(stiffness)
        self.changed.append(f"joint {name}: drive's stiffness {stiffness:.6g}")

    def inertial(self, name: str, joint: int) -> None:
        """Scale mass and inertia of a joint's link, and move its centre of gravity.

        A link is the joint's body and all that fixed joints carry from it.
        """
        scale = 1 + self.changes.of_joint(Kind.LINK_SCALE, joint)
        moment = self.changes.vector(Kind.LINK_MOMENT, joint)
        if scale == 1 and not moment.any():
            return
        path = self.stage.body(self.stage.joints[name], 1)
        masses = {body: self.stage.mass(body) for body in self.stage.fixed_to(path)}
        if not self.changes.is_one_link(joint, [m * self.stage.kilogram for m in masses.values()]):
            masses = {path: masses[path]}
        masses = {body: mass for body, mass in masses.items() if mass > 0}
        if not masses:
            self.missing.append(f"inertia of {path}: it has no physics:mass that could be scaled")
            return
        moment_in_world = (self.world @ self.changes.joint_in_base[joint - 1])[:3, :3] @ moment
        shift = moment_in_world / (sum(masses.values()) * scale * self.stage.kilogram)
        for body, mass in masses.items():
            prim = self.stage.UsdPhysics.MassAPI(self.stage.stage.GetPrimAtPath(body))
            if scale != 1:
                prim.CreateMassAttr().Set(mass * scale)
                inertia = prim.GetDiagonalInertiaAttr().Get()
                if inertia:
                    prim.CreateDiagonalInertiaAttr().Set(inertia * scale)
                self.changed.append(f"{body}: mass and inertia times {scale:.6g}")
            if moment.any():
                in_body = self.stage.frames[body][:3, :3].T @ shift
                authored = prim.GetCenterOfMassAttr().Get()
                centre = np.array(authored or (0, 0, 0), dtype=float)
                centre = np.where(np.isfinite(centre), centre, 0.0) + in_body / self.stage.unit
                prim.CreateCenterOfMassAttr().Set(self.stage.Gf.Vec3f(*(float(v) for v in centre)))
                self.changed.append(f"{body}: physics:centerOfMass")

    def springs(self, name: str, joint: int) -> None:
        """Add play and springs between a joint and its body: a small body and a joint each."""
        frame = self.world @ self.changes.joint_in_base[joint - 1]
        flexibility = self.changes.springs.joint[joint - 1]
        softening = self.changes.springs.softening[joint - 1]
        play = self.changes.of_joint(Kind.PLAY, joint)
        if play or flexibility.any():
            self._keep_apart(self.stage.joints[name])
        if play:
            self._add_spring(name, "backlash", frame, 2, half=play / 2)
        for k, label in ((2, "axial_compliance"), (0, "radial_x"), (1, "radial_y")):
            if flexibility[k] > 0:
                self._add_spring(name, label, frame, k, stiffness=1 / float(flexibility[k]))
        if softening > 0:
            self.missing.append(f"stiffening of {name}: its spring is the linear one; a drive's "
                                "stiffness by angle needs code")  # fmt: skip

    def _keep_apart(self, joint: Any) -> None:
        """Filter the contacts of a joint's bodies, which simulators do while it joins them."""
        stage = self.stage
        parent, child = stage.body(joint, 0), stage.body(joint, 1)
        if parent and not joint.GetCollisionEnabledAttr().Get():
            pairs = stage.UsdPhysics.FilteredPairsAPI.Apply(stage.stage.GetPrimAtPath(child))
            pairs.CreateFilteredPairsRel().AddTarget(parent)

    def _add_spring(
        self, name: str, label: str, cell_frame: Array, k: int, stiffness: float = 0.0,
        half: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a body and a joint about axis ``k`` of the cell's joint, its frame (4, 4) in world.

        The stage's own joint can be elsewhere on the axis, where an axis across it is another line.
        """
        stage, joint = self.stage, self.stage.joints[name]
        child = stage.body(joint, 1)
        path = f"{joint.GetPath()}_{label}"
        body = stage.UsdGeom.Xform.Define(stage.stage, f"{path}_body")
        stage.UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
        mass = stage.UsdPhysics.MassAPI.Apply(body.GetPrim())
        mass.CreateMassAttr().Set(SMALL / stage.kilogram)
        mass.CreateDiagonalInertiaAttr().Set(stage.Gf.Vec3f(SMALL / self._torque_unit()))
        frame = stage.frames[child] @ stage.local(joint, 1)
        stage.frames[f"{path}_body"] = frame
        self._place(body, frame)
        spring = stage.UsdPhysics.RevoluteJoint.Define(stage.stage, path)
        spring.CreateAxisAttr().Set("Z")
        spring.CreateBody0Rel().SetTargets([f"{path}_body"])
        spring.CreateBody1Rel().SetTargets([child])
        spring_frame = transform(_with_z(cell_frame[:3, k]), cell_frame[:3, 3])
        stage.set_local(spring, 0, np.linalg.inv(frame) @ spring_frame)
        stage.set_local(spring, 1, np.linalg.inv(stage.frames[child]) @ spring_frame)
        joint.GetBody1Rel().SetTargets([f"{path}_body"])
        stage.set_local(joint, 1, np.eye(4))
        if half:
            spring.CreateLowerLimitAttr().Set(float(-np.degrees(half)))
            spring.CreateUpperLimitAttr().Set(float(np.degrees(half)))
            self.changed.append(f"joint {name}_{label}: +-{half:.6g} rad")
            return
        drive = stage.UsdPhysics.DriveAPI.Apply(spring.GetPrim(), "angular")
        drive.CreateTypeAttr().Set("force")
        value = stiffness * PER_DEGREE / self._torque_unit()
        drive.CreateStiffnessAttr().Set(value)
        drive.CreateDampingAttr().Set(0.01 * value)
        drive.CreateTargetPositionAttr().Set(0.0)
        self.changed.append(f"joint {name}_{label}: drive's stiffness {value:.6g} per degree")

    def _place(self, xform: Any, frame: Array) -> None:
        """Place a new prim at a frame (4, 4) in world."""
        cache = self.stage.UsdGeom.XformCache()
        parent = np.array(cache.GetParentToWorldTransform(xform.GetPrim())).T
        scaled = frame.copy()
        scaled[:3, 3] /= self.stage.unit
        matrix = np.linalg.inv(parent) @ scaled
        xform.AddTransformOp().Set(self.stage.Gf.Matrix4d(matrix.T.tolist()))

    def tool(self) -> None:
        """Move the Xform of the TCP, given by path or name."""
        stage = self.stage.stage
        prims = [p for p in stage.Traverse() if p.IsA(self.stage.UsdGeom.Xformable)]
        tcp = self.options.tcp
        if tcp and tcp not in [str(p.GetPath()) for p in prims]:
            known_name(self.stage.path, "--tcp", tcp, [p.GetName() for p in prims])
            paths = [str(p.GetPath()) for p in prims if p.GetName() == tcp]
            if len(paths) > 1:
                raise InputError(
                    f"{self.stage.path}: --tcp: found {tcp} as {' and '.join(paths)}, expected the "
                    "path of one"
                )
            tcp = paths[0]
        if np.allclose(self.changes.tcp_shift, np.eye(4), rtol=0, atol=TOLERANCE):
            return
        if not tcp:
            self.missing.append("tool: name the Xform of the TCP with --tcp")
            return
        frame = self.world @ self.changes.tcp_in_base
        motion = frame @ self.changes.tcp_shift @ np.linalg.inv(frame)
        last = self.stage.last_body(self.names[-1])
        placement = self.stage.authored(last) @ np.linalg.inv(self.stage.frames[last])
        self.stage.move(tcp, placement @ motion @ np.linalg.inv(placement))
        self.changed.append(f"{tcp}: TCP")

    def gravity(self) -> None:
        """Turn the scene's gravity."""
        gravity = self.changes.gravity
        if gravity is None:
            return
        scenes = [p for p in self.stage.stage.Traverse() if p.IsA(self.stage.UsdPhysics.Scene)]
        if not scenes:
            self.missing.append("direction of gravity: physics:gravityDirection of the scene")
            return
        scene = self.stage.UsdPhysics.Scene(scenes[0])
        in_world, size = self.world[:3, :3] @ gravity, float(np.linalg.norm(gravity))
        unit = in_world / size
        scene.CreateGravityDirectionAttr().Set(self.stage.Gf.Vec3f(*(float(v) for v in unit)))
        scene.CreateGravityMagnitudeAttr().Set(size / self.stage.unit)
        self.changed.append(f"{scenes[0].GetPath()}: gravity")

    def unsupported(self) -> list[str]:
        """Return the changes that are not in the layer, with what to do instead."""
        kinds = {setting.kind for setting in self.changes.settings}
        lines = self.missing + [text for kind, text in INSTEAD.items()
                                if kind in kinds and kind is not Kind.LINK_MOMENT]  # fmt: skip
        if self.changes.springs.link.any():
            lines.append("flexible links: MJCF with springs across the links")
        if self.changes.springs.base.any():
            lines.append("flexible base: driven joints between the base and the world")
        lines += [f"{name}: {text}" for name, text in self.changes.unsupported]
        return [*lines, *self.changes.skipped]


def _with_z(axis: Array) -> Array:
    """Return a rotation (3, 3) whose z is a unit vector."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
