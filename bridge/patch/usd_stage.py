"""A user's USD stage under a new, stronger layer: its joints, bodies and frames, in m."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gapbridge.bridge.patch.changes import TOLERANCE, Axes, ModelChanges
from gapbridge.bridge.patch.model_format import PatchOptions, pick_joints
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError
from gapbridge.core.files import require_utf8
from gapbridge.core.rotation import transform

if TYPE_CHECKING:
    from collections.abc import Iterator

AT_ZERO = 1e-5  # m, and of rotation matrices: tolerance for a body to be at zero angles


class Stage:
    """A user's stage under a new, stronger layer; lengths are converted to m."""

    def __init__(self, path: Path, folder: Path | None) -> None:
        try:
            from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics
        except ImportError:
            raise InputError(
                f"{path}: found a USD model, expected USD's Python package to be installed: "
                "pip install 'gapbridge[usd]'"
            ) from None
        require_utf8(path.resolve())
        self.Gf, self.Sdf, self.UsdGeom, self.UsdPhysics = Gf, Sdf, UsdGeom, UsdPhysics
        self.path, self.layer = path, Sdf.Layer.CreateAnonymous(".usda")
        self.layer.subLayerPaths.append(str(path.resolve()))
        try:
            source = Usd.Stage.Open(
                str(path)
            )  # first: where it is a sublayer, USD prints a warning
            self.stage: Any = Usd.Stage.Open(self.layer)
        except Tf.ErrorException:
            raise InputError(f"{path}: found no USD that opens, expected a stage") from None
        self.default = source.GetDefaultPrim()
        self.folder = folder or path.parent
        self.unit = UsdGeom.GetStageMetersPerUnit(source)
        self.kilogram = UsdPhysics.GetStageKilogramsPerUnit(source)
        self.paths: dict[str, list[str]] = {}  # of the joints of a name: of several robots
        for prim in self.stage.Traverse():
            if prim.IsA(UsdPhysics.RevoluteJoint):
                self.paths.setdefault(prim.GetName(), []).append(str(prim.GetPath()))
        self.joints: dict[str, Any] = {  # by name, or by path where several have the name
            name if len(paths) == 1 else path: UsdPhysics.RevoluteJoint.Get(self.stage, path)
            for name, paths in self.paths.items()
            for path in paths
        }
        self._carried = {name: self.body(joint, 1) for name, joint in self.joints.items()}
        self._hung = {self.body(j, 1) for j in self._every_joint() if not self.is_fixed(j)}
        self.frames = self._at_zero()

    def pick_joints(self, changes: ModelChanges, options: PatchOptions) -> tuple[str, ...]:
        """Return the arm's joints, as in ``joints``; the user's may be names or prim paths.

        Raises InputError where they cannot be assigned, or several joints have the name of one.
        """
        name_of = {str(joint.GetPath()): name for name, joint in self.joints.items()}
        chosen = tuple(name_of.get(given, given) for given in options.joints)
        known = list(dict.fromkeys([*self.paths, *self.joints] if chosen else self.paths))
        names = pick_joints(self.path, known, changes, replace(options, joints=chosen))
        for name in names:
            if name not in self.joints:
                raise InputError(
                    f"{self.path}: joints: found {name} as {' and '.join(self.paths[name])}, "
                    "expected one of them; name the arm's joints by their paths with --joints"
                )
        return names

    def _at_zero(self) -> dict[str, Array]:
        """Return the poses (4, 4) of bodies at zero angles, joint by joint from the roots."""
        frames: dict[str, Array] = {}
        remaining = [(joint, *self._sides(joint)) for joint in self._every_joint()]
        carried = {self.body(joint, outer) for joint, _, outer in remaining}
        for joint, inner, _ in remaining:
            root = self.body(joint, inner)
            if root not in carried:
                frames[root] = self.authored(root)
        while ready := [given for given in remaining if self.body(given[0], given[1]) in frames]:
            for joint, inner, outer in ready:
                parent = frames[self.body(joint, inner)]
                local = self.local(joint, inner) @ np.linalg.inv(self.local(joint, outer))
                frames.setdefault(self.body(joint, outer), parent @ local)
            remaining = [given for given in remaining if given not in ready]
        return frames  # without closed chains, whose joints cannot be an arm's

    def _sides(self, joint: Any) -> tuple[int, int]:
        """Return the sides of the carrying and of the carried body.

        They are 0 and 1 but for a fixed joint whose body 1 hangs on a turning joint already.
        """
        turned = self.is_fixed(joint) and self.body(joint, 0) and self.body(joint, 1) in self._hung
        return (1, 0) if turned else (0, 1)

    def is_fixed(self, joint: Any) -> bool:
        """Return whether a joint holds its bodies together rigidly."""
        return bool(joint.GetPrim().IsA(self.UsdPhysics.FixedJoint))

    def move_bodies(self) -> bool:
        """Move bodies as the changed joints require; False: they were not at zero angles."""
        original = {path: self.authored(path) for path in self.frames}
        for path, frame in self.frames.items():
            if not np.allclose(original[path], frame, rtol=0, atol=AT_ZERO):
                return False
        for path, frame in self._at_zero().items():  # parents come first
            current = self.authored(path)
            if path and not np.allclose(current, frame, rtol=0, atol=TOLERANCE):
                self.move(path, frame @ np.linalg.inv(current))
        return True

    def _every_joint(self) -> Iterator[Any]:
        for prim in self.stage.Traverse():
            if prim.IsA(self.UsdPhysics.Joint):
                joint = self.UsdPhysics.Joint(prim)
                if self.body(joint, 1):
                    yield joint

    def body(self, joint: Any, side: int) -> str:
        """Return the path of one of a joint's bodies, '' for the world."""
        relation = joint.GetBody0Rel() if side == 0 else joint.GetBody1Rel()
        targets = relation.GetTargets()
        return str(targets[0]) if targets else ""

    def fixed_to(self, path: str) -> list[str]:
        """Return a body and all that fixed joints carry from it."""
        fixed = [(joint, *self._sides(joint)) for joint in self._every_joint()
                 if self.is_fixed(joint)]  # fmt: skip
        found = [path]
        for body in found:  # which grows meanwhile
            carried = [self.body(joint, outer) for joint, inner, outer in fixed
                       if self.body(joint, inner) == body]  # fmt: skip
            found += [child for child in carried if child not in found]
        return found

    def mass(self, path: str) -> float:
        """Return a body's own physics:mass in the stage's unit, 0 where it has none."""
        attribute = self.UsdPhysics.MassAPI(self.stage.GetPrimAtPath(path)).GetMassAttr()
        return float(attribute.Get() or 0.0) if attribute else 0.0

    def authored(self, path: str) -> Array:
        """Return a prim's frame (4, 4) in world as the stage has it, m."""
        if not path:
            return np.eye(4)
        prim = self.stage.GetPrimAtPath(path)
        cache = self.UsdGeom.XformCache()
        matrix = np.array(cache.GetLocalToWorldTransform(prim)).T
        matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)
        matrix[:3, 3] *= self.unit
        return matrix

    def local(self, joint: Any, side: int) -> Array:
        """Return a joint's frame (4, 4) in one of its bodies."""
        rotation = joint.GetLocalRot0Attr() if side == 0 else joint.GetLocalRot1Attr()
        position = joint.GetLocalPos0Attr() if side == 0 else joint.GetLocalPos1Attr()
        quat, point = rotation.Get(), position.Get()
        R = np.eye(3) if quat is None else _matrix(quat.GetReal(), quat.GetImaginary())
        scale = self._scale(self.body(joint, side))
        p = np.zeros(3) if point is None else np.array(point, dtype=float) * scale * self.unit
        return transform(R, p)

    def last_body(self, joint: str) -> str:
        """Return the body that a joint carried in the original stage."""
        return self._carried[joint]

    def _scale(self, path: str) -> Array:
        """Return the scale (3,) of a prim's axes in world, which applies to joints' positions."""
        if not path:
            return np.ones(3)
        matrix = np.array(
            self.UsdGeom.XformCache().GetLocalToWorldTransform(self.stage.GetPrimAtPath(path))
        )
        return np.asarray(np.linalg.norm(matrix[:3, :3], axis=1))

    def axes(self, names: Sequence[str]) -> Axes:
        """Return the lines of joints' axes at zero angles."""
        point, direction = [], []
        for name in names:
            frame = self.in_world(self.joints[name])
            point.append(frame[:3, 3])
            direction.append(frame[:3, self.axis(self.joints[name])])
        return Axes(np.array(point), np.array(direction))

    def axis(self, joint: Any) -> int:
        """Return which axis of its frame a joint turns about."""
        return "XYZ".index(str(joint.GetAxisAttr().Get() or "X"))

    def in_world(self, joint: Any) -> Array:
        """Return a joint's frame (4, 4) in world at zero angle. Raises InputError if unknown."""
        parent = self.frames.get(self.body(joint, 0))
        if parent is None:
            raise InputError(
                f"{self.path}: joint {joint.GetPrim().GetName()}: found a closed chain, expected "
                "a tree"
            )
        return np.asarray(parent @ self.local(joint, 0))

    def set_local(self, joint: Any, side: int, frame: Array) -> None:
        """Write a joint's frame (4, 4) in one of its bodies."""
        w, x, y, z = _quat(frame[:3, :3])
        rotation = joint.CreateLocalRot0Attr() if side == 0 else joint.CreateLocalRot1Attr()
        position = joint.CreateLocalPos0Attr() if side == 0 else joint.CreateLocalPos1Attr()
        point = frame[:3, 3] / self.unit / self._scale(self.body(joint, side))
        rotation.Set(self.Gf.Quatf(w, x, y, z))
        position.Set(self.Gf.Vec3f(*(float(v) for v in point)))

    def move(self, path: str, motion: Array) -> None:
        """Move a prim by a motion (4, 4) in world; one matrix replaces its transform steps."""
        prim = self.UsdGeom.Xformable(self.stage.GetPrimAtPath(path))
        cache = self.UsdGeom.XformCache()
        current = np.array(cache.GetLocalToWorldTransform(prim.GetPrim())).T
        parent = np.array(cache.GetParentToWorldTransform(prim.GetPrim())).T
        step = motion.copy()
        step[:3, 3] /= self.unit
        local = np.linalg.inv(parent) @ step @ current
        prim.ClearXformOpOrder()
        prim.AddTransformOp(opSuffix="patched").Set(self.Gf.Matrix4d(local.T.tolist()))

    def set(self, prim: Any, name: str, kind: str, value: Any) -> None:
        """Write an attribute, which is created where the prim has none."""
        attribute = prim.GetAttribute(name) or prim.CreateAttribute(
            name, getattr(self.Sdf.ValueTypeNames, kind)
        )
        attribute.Set(value)

    def text(self, comment: Sequence[str]) -> str:
        """Return the layer's text, the model's path relative to the layer's folder."""
        relative = Path(os.path.relpath(self.path.resolve(), self.folder.resolve())).as_posix()
        layer = self.Sdf.Layer.CreateAnonymous(".usda")  # the stage would look for the path
        layer.TransferContent(self.layer)
        layer.subLayerPaths[0] = relative if relative.startswith(".") else f"./{relative}"
        layer.comment = "\n".join(comment)
        if self.default:
            layer.defaultPrim = self.default.GetName()
        return str(layer.ExportToString())


def _matrix(w: float, xyz: Any) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat([*xyz, w]).as_matrix())


def _quat(R: Array) -> tuple[float, float, float, float]:
    """Return a rotation (3, 3) as quaternion w, x, y, z."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return float(w), float(x), float(y), float(z)
