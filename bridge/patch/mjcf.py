"""MJCF through MuJoCo's own MjSpec: what compiles there is what a user's simulation runs.

Flexibility and play are further joints in the joint's own body, named after it; sensors and
actuators stay on the joint itself, whose angle is the encoder's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.patch.changes import TINY, Axes, ModelChanges, base_in_world
from gapbridge.bridge.patch.model_format import (
    ModelFormat,
    Patched,
    PatchOptions,
    named_one,
    pick_joints,
)
from gapbridge.core.effects.simulator import Kind
from gapbridge.core.errors import InputError
from gapbridge.core.rotation import transform

Array = NDArray[np.float64]
ARMATURE = 1e-3  # kg m2 of a further joint, which MuJoCo needs to integrate stiff springs
DAMPING = 0.3  # ratio of a further joint's damping to the critical one
PLAY_ARMATURE, PLAY_SOLREF = 1e-3, (0.004, 1.0)
SMALL = 1e-6  # kg m2 of a point mass: MuJoCo asks for more than none


class Mjcf(ModelFormat):
    """MuJoCo's XML."""

    suffixes = (".xml", ".mjcf")

    def patch(self, path: Path, changes: ModelChanges, options: PatchOptions,
              notes: Sequence[str]) -> Patched:  # fmt: skip
        """Return the MJCF with the changes in it, as MjSpec writes it."""
        scene = _Scene(path)
        names = pick_joints(path, scene.hinges(), changes, options)
        world = base_in_world(changes.axes(), scene.axes(names), str(path), names)
        changed: list[str] = []
        for i, name in enumerate(names):
            if not np.allclose(changes.shift[i], np.eye(4), rtol=0, atol=TINY):
                scene.move(scene.body_of(name), changes.moved(i, world))
                changed.append(f"joint {name}: its body's frame")
            changed += _joint(scene, name, i + 1, changes)
            changed += _actuator(scene, name, i + 1, changes, options)
            changed += _springs(scene, name, i, changes, world)
            changed += _scale(scene, name, changes.of_joint(Kind.LINK_SCALE, i + 1))
        missing = _tool(scene, path, changes, options, world, changed)
        missing += _load(scene, names, changes, world, changed)
        missing += _rest(scene, changes)
        if changes.gravity is not None:
            scene.spec.option.gravity = world[:3, :3] @ changes.gravity
            changed.append("option: gravity")
        before = scene.compiled.nq
        scene.pad_keyframes()
        after = scene.spec.compile().nq
        if after != before:
            changed.append(f"nq is {after} instead of {before}: actuators stay as they are, "
                           "qpos has the further joints in it")  # fmt: skip
        scene.spec.comment = "\n".join(
            ["Patched by gapbridge.", *changed, *notes, *(f"not in here: {m}" for m in missing)]
        ).replace("--", "- -")  # fmt: skip
        return Patched(scene.spec.to_xml(), tuple(changed), tuple(missing))


class _Scene:
    """A user's model: its spec, which is changed, and what it compiles to as it came."""

    def __init__(self, path: Path) -> None:
        try:
            import mujoco
        except ImportError:
            raise InputError(
                f"{path}: found an MJCF model, expected MuJoCo to be installed: pip install mujoco"
            ) from None
        self.mujoco = mujoco
        try:
            self.spec: Any = mujoco.MjSpec.from_file(str(path))
            self.compiled: Any = self.spec.compile()
        except (ValueError, OSError) as error:
            text = " ".join(str(error).split())
            raise InputError(f"{path}: found no MJCF that compiles ({text})") from None
        self.data: Any = mujoco.MjData(self.compiled)
        for j in range(self.compiled.njnt):  # joints at their angle zero, ref is no angle
            self.data.qpos[self.compiled.jnt_qposadr[j]] = 0
        mujoco.mj_kinematics(self.compiled, self.data)
        mujoco.mj_comPos(self.compiled, self.data)

    def hinges(self) -> list[str]:
        hinge = self.mujoco.mjtJoint.mjJNT_HINGE
        return [j.name for j in self.spec.joints if j.type == hinge]

    def axes(self, names: Sequence[str]) -> Axes:
        ids = [self.compiled.joint(name).id for name in names]
        return Axes(self.data.xanchor[ids].copy(), self.data.xaxis[ids].copy())

    def body_of(self, joint: str) -> Any:
        return self.spec.joint(joint).parent

    def frame(self, body: Any) -> Array:
        """Return a body's frame (4, 4) in world, joints at zero, as the model came."""
        i = self.compiled.body(body.name).id if body.name else 0
        return transform(self.data.xmat[i].reshape(3, 3), self.data.xpos[i])

    def move(self, body: Any, motion: Array) -> None:
        """Move a body and all beyond by a motion (4, 4) in world."""
        parent = self.frame(body.parent)
        local = np.linalg.inv(parent) @ motion @ self.frame(body)
        self.place(body, local)

    def place(self, element: Any, local: Array) -> None:
        """Set an element's frame in its parent's."""
        quat = np.zeros(4)
        self.mujoco.mju_mat2Quat(quat, local[:3, :3].ravel())
        element.pos, element.quat = local[:3, 3], quat
        element.alt.type = self.mujoco.mjtOrientation.mjORIENTATION_QUAT

    def inertia_about(self, joint: str, axis: Array) -> float:
        """Return the inertia (kg m2) of all beyond a joint about an axis (world) at its anchor."""
        j = self.compiled.joint(joint).id
        body, anchor = self.compiled.jnt_bodyid[j], self.data.xanchor[j]
        total = 0.0
        for k in range(body, self.compiled.nbody):
            up = k
            while up > body:
                up = self.compiled.body_parentid[up]
            if up == body:
                away = np.cross(axis, self.data.xipos[k] - anchor)
                total += self.compiled.body_mass[k] * float(away @ away)
        return total + ARMATURE

    def further_joint(self, joint: str, name: str, axis: Array, **settings: Any) -> None:
        """Add a hinge after a joint, in its body and at its anchor; ``axis`` in body axes."""
        own = self.spec.joint(joint)
        own.parent.add_joint(
            name=f"{joint}_{name}", type=self.mujoco.mjtJoint.mjJNT_HINGE, axis=axis,
            pos=np.array(own.pos), **settings,
        )  # fmt: skip

    def pad_keyframes(self) -> None:
        """Write the keyframes' qpos anew, further joints at zero."""
        given = [(key, np.array(key.qpos)) for key in self.spec.keys]
        if not any(len(qpos) for _, qpos in given):
            return
        old = self.compiled
        size = {0: 7, 1: 4, 2: 1, 3: 1}  # of qpos: free, ball, slide, hinge
        for key, qpos in given:
            if not len(qpos):
                continue
            parts = []
            for joint in self.spec.joints:
                if joint.name and _has(old, joint.name):
                    begin = old.joint(joint.name).qposadr[0]
                    parts.append(qpos[begin : begin + size[int(joint.type)]])
                else:
                    parts.append(np.zeros(1))
            key.qpos = np.concatenate(parts)
            key.qvel = []


def _has(compiled: Any, joint: str) -> bool:
    try:
        compiled.joint(joint)
    except KeyError:
        return False
    return True


def _joint(scene: _Scene, name: str, joint: int, changes: ModelChanges) -> list[str]:
    """Add friction, damping and armature."""
    own, lines = scene.spec.joint(name), []
    friction = changes.of_joint(Kind.FRICTION, joint)
    damping = changes.of_joint(Kind.DAMPING, joint)
    armature = changes.of_joint(Kind.ARMATURE, joint)
    if friction:
        own.frictionloss += friction
        lines.append(f"joint {name}: frictionloss {own.frictionloss:.6g}")
    if damping:
        linear = np.array(own.damping)
        linear[0] += damping
        own.damping = linear
        lines.append(f"joint {name}: damping {linear[0]:.6g}")
    if armature:
        own.armature += armature
        lines.append(f"joint {name}: armature {own.armature:.6g}")
    return lines


def _actuator(scene: _Scene, name: str, joint: int, changes: ModelChanges,
              options: PatchOptions) -> list[str]:  # fmt: skip
    """Set delay, lag and gain of the position actuator of a joint."""
    delay, lag = changes.of_joint(Kind.DELAY, joint), changes.of_joint(Kind.LAG, joint)
    droop = changes.of_joint(Kind.SERVO_COMPLIANCE, joint)
    if not (delay or lag or droop):
        return []
    drive = next((a for a in scene.spec.actuators if a.target == name), None)
    if drive is None:
        raise InputError(
            f"{scene.spec.modelname}: joint {name}: found no actuator, expected one for its "
            "delay, lag or gain"
        )
    lines = []
    if delay:
        drive.delay = delay
        drive.nsample = int(np.ceil(delay / scene.spec.option.timestep)) + 1
        lines.append(f"actuator of {name}: delay {delay:.6g} s")
    if lag:
        drive.dyntype = scene.mujoco.mjtDyn.mjDYN_FILTEREXACT
        parameters = np.array(drive.dynprm)
        parameters[0] = lag
        drive.dynprm = parameters
        lines.append(f"actuator of {name}: timeconst {lag:.6g} s")
    if droop:
        gain, bias = np.array(drive.gainprm), np.array(drive.biasprm)
        given = 1 / gain[0] if options.on_top and gain[0] > 0 else 0.0  # rad/Nm, as it came
        droop += given
        if gain[0] > 0 > bias[2]:  # a damping ratio, which is positive there, holds by itself
            bias[2] /= np.sqrt(droop * gain[0])
        gain[0], bias[1] = 1 / droop, -1 / droop
        drive.gainprm, drive.biasprm = gain, bias
        lines.append(f"actuator of {name}: kp {1 / droop:.6g}")
    return lines


def _springs(scene: _Scene, name: str, i: int, changes: ModelChanges, world: Array) -> list[str]:
    """Add play and springs behind a joint: about its axis, then across it."""
    lines = []
    turned = scene.frame(scene.body_of(name))[:3, :3]
    frame = (world @ changes.joint_in_base[i])[:3, :3]
    play = changes.of_joint(Kind.PLAY, i + 1)
    if play:
        half = play / 2
        degrees = scene.spec.compiler.degree
        limits = np.degrees([-half, half]) if degrees else np.array([-half, half])
        scene.further_joint(
            name, "backlash", turned.T @ frame[:, 2], limited=1, range=limits,
            armature=PLAY_ARMATURE, solref_limit=PLAY_SOLREF,
        )  # fmt: skip
        lines.append(f"joint {name}_backlash: +-{half:.6g} rad")
    flexibility, softening = changes.springs.joint[i], changes.springs.softening[i]
    for k, label in ((2, "axial_compliance"), (0, "radial_x"), (1, "radial_y")):
        c = float(flexibility[k])
        if c <= 0:
            continue
        stiffness = np.zeros(3)
        stiffness[0] = 1 / c
        if k == 2 and softening > 0:
            # the inverse of theta = c M / sqrt(1 + M^2 s) is M = theta/c (1 + theta^2 s / 2 c^2)
            stiffness[2] = softening / (2 * c**3)
        inertia = scene.inertia_about(name, frame[:, k])
        damping = np.zeros(3)
        damping[0] = 2 * DAMPING * np.sqrt(inertia / c)
        scene.further_joint(
            name, label, turned.T @ frame[:, k], stiffness=stiffness, damping=damping,
            armature=ARMATURE,
        )  # fmt: skip
        lines.append(f"joint {name}_{label}: stiffness {1 / c:.6g} Nm/rad")
    return lines


def _scale(scene: _Scene, name: str, increase: float) -> list[str]:
    """Scale mass and inertia of a joint's body."""
    if not increase:
        return []
    body = scene.body_of(name)
    compiled = scene.compiled.body(body.name)
    factor = 1 + increase
    body.explicitinertial = True
    body.mass = float(compiled.mass[0]) * factor
    body.ipos, body.iquat = compiled.ipos, compiled.iquat
    body.inertia = compiled.inertia * factor
    return [f"body {body.name}: mass and inertia times {factor:.6g}"]


def _tool(
    scene: _Scene, path: Path, changes: ModelChanges, options: PatchOptions, world: Array,
    changed: list[str],
) -> list[str]:  # fmt: skip
    if np.allclose(changes.tcp_shift, np.eye(4), rtol=0, atol=TINY):
        return []
    sites = [site.name for site in scene.spec.sites]
    if not options.tcp:
        return [f"tool: name the site of the TCP with --tcp ({', '.join(sites) or 'none'})"]
    site = scene.spec.site(named_one(path, "--tcp", options.tcp, sites))
    frame = world @ changes.tcp_in_base
    motion = frame @ changes.tcp_shift @ np.linalg.inv(frame)
    i = scene.compiled.site(site.name).id
    own = transform(scene.data.site_xmat[i].reshape(3, 3), scene.data.site_xpos[i])
    scene.place(site, np.linalg.inv(scene.frame(site.parent)) @ motion @ own)
    changed.append(f"site {site.name}: TCP")
    return []


def _load(
    scene: _Scene, names: Sequence[str], changes: ModelChanges, world: Array, changed: list[str]
) -> list[str]:
    """Hang what the load weighs more onto the last body."""
    extra = sum(s.value for s in changes.settings if s.kind is Kind.PAYLOAD)
    if not extra:
        return []
    if extra < 0:
        return [f"load: {-extra:.6g} kg less than declared; take it off the body that models it"]
    last = scene.body_of(names[-1])
    centre = world @ changes.joint_in_base[-1] @ np.append(changes.model.payload_cog, 1.0)
    at = np.linalg.inv(scene.frame(last)) @ centre
    load = last.add_body(name="payload_difference", pos=at[:3])
    load.explicitinertial, load.mass, load.inertia = True, extra, [SMALL] * 3
    load.ipos = np.zeros(3)  # without it MuJoCo's writer leaves the inertial out
    changed.append(f"body payload_difference: {extra:.6g} kg")
    return []


def _rest(scene: _Scene, changes: ModelChanges) -> list[str]:
    lines = []
    if changes.springs.link.any():
        lines.append("flexible links: a pair of springs across the link at a third of its length, "
                     "4 EI / 3 L each")  # fmt: skip
    if changes.springs.base.any():
        lines.append("flexible base: two joints with springs in the base's body")
    lifted = [b.name for b in scene.spec.bodies if b.gravcomp]
    if lifted:
        lines.append(f"gravcomp of {', '.join(lifted)} takes out what springs and servos give way")
    return lines + [f"{name}: {instead}" for name, instead in changes.not_held]
