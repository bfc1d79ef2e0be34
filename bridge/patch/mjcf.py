"""MJCF, edited with MuJoCo's MjSpec.

Flexibility and play are additional joints in the joint's body, named after it; sensors and
actuators stay on the joint itself, whose angle is the encoder's. A flexible base or link is an
inserted body with hinges before the joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.document.numbers import percent
from gapbridge.bridge.patch.changes import TOLERANCE, ModelChanges, base_in_world
from gapbridge.bridge.patch.mjcf_scene import Hinge, Scene
from gapbridge.bridge.patch.model_format import (
    MARK,
    ModelFormat,
    Patched,
    PatchOptions,
    known_name,
    pick_joints,
)
from gapbridge.core.arrays import Array
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.effects.simulator import Kind
from gapbridge.core.errors import InputError
from gapbridge.core.rotation import rotation_matrix, transform

PLAY_DECELERATION = 0.2  # rad/s2: up to this deceleration friction holds the play taken up
GAUSS = (0.5 - 3**0.5 / 6, 0.5 + 3**0.5 / 6)  # of a length: two points of quadrature
MOMENT_RANGE = 1.5  # times a joint's typical moment: range over which a stiffening spring is fitted
TOLERATED = 0.06  # share of the largest angle by which such a spring may be off unreported
LINEAR = 1  # an actuator's interp: linear interpolation
POINT_INERTIA = 1e-6  # kg m2 of a point mass: MuJoCo requires more than zero


class Mjcf(ModelFormat):
    """MuJoCo's XML."""

    suffixes = (".xml", ".mjcf")
    text_suffixes = suffixes
    holds_load = True

    def patch(self, path: Path, changes: ModelChanges, options: PatchOptions,
              notes: Sequence[str]) -> Patched:  # fmt: skip
        """Return the MJCF with the changes in it, as MjSpec writes it."""
        scene = Scene(path)
        names = pick_joints(path, scene.hinges(), changes, options)
        world = base_in_world(changes.axes(), scene.axes(names), str(path), names)
        model = _Patch(scene, names, world, changes, options)
        if disabled := scene.make_inertials_explicit():
            model.changed.append(
                f"compiler: {', '.join(disabled)} off; every body has its inertial"
            )
        for joint, name in enumerate(names, start=1):
            model.frame(name, joint)
            model.friction(name, joint)
            model.actuator(name, joint)
            model.springs(name, joint)
            model.inertial(name, joint)
        model.base()
        model.links()
        model.tool()
        model.sensor()
        model.load()
        if changes.gravity is not None:
            scene.spec.option.gravity = world[:3, :3] @ changes.gravity
            model.changed.append("option: gravity")
        if scene.added_joints:
            before = scene.compiled.nq
            model.changed.append(
                f"nq is {before + scene.added_joints} instead of {before}: actuators stay as they "
                "are, qpos has the further joints in it"
            )
        missing = model.unsupported()
        comment = [MARK, *model.changed, *notes,
                   *(f"not in here: {line}" for line in missing)]  # fmt: skip
        return Patched(scene.text(comment, options.folder), tuple(model.changed), tuple(missing))


def _stiffening(
    c: float, softening: float, moment_limit: float
) -> tuple[tuple[float, float, float], float]:
    """Return a spring's polynomial for theta = c M / sqrt(1 + softening M^2), and its error.

    The law's inverse is an infinite series of odd powers; MuJoCo's spring has linear and cubic
    terms, whose factors minimise the squared error of the angle up to ``moment_limit`` Nm. The
    error is the largest one of the angle there, as a share of the largest angle.
    """
    moment = np.linspace(0.0, moment_limit, 200)[1:]
    root = np.sqrt(1 + softening * moment**2)
    angle, slope = c * moment / root, c / root**3
    columns = np.column_stack([angle, angle**3]) * slope[:, None]
    scale = np.linalg.norm(columns, axis=0)
    linear, cubic = np.linalg.lstsq(columns / scale, moment * slope, rcond=None)[0] / scale
    if linear <= 0 or cubic <= 0:  # the spring would push: the series' first terms instead
        linear, cubic = 1 / c, softening / (2 * c**3)
    found = np.minimum(moment / linear, np.cbrt(moment / cubic))  # above the root, as Newton needs
    for _ in range(50):
        error = linear * found + cubic * found**3 - moment
        found -= error / (linear + 3 * cubic * found**2)
    share = float(np.abs(found - angle).max() / angle.max())
    return (float(linear), 0.0, float(cubic)), share


def _named(body: Any) -> str:
    """Return a body's name, or its number where it has none."""
    return str(body.name) or f"#{body.id}"


class _Patch:
    """One model being patched, with a line per change and per change that is not possible."""

    def __init__(self, scene: Scene, names: Sequence[str], world: Array, changes: ModelChanges,
                 options: PatchOptions) -> None:  # fmt: skip
        self.scene, self.names, self.world = scene, names, world
        self.changes, self.options = changes, options
        self.changed: list[str] = []
        self.missing: list[str] = []

    def joint_in_world(self, joint: int) -> Array:
        """Return the nominal frame (4, 4) of a joint (from 1; n + 1: the flange)."""
        return np.asarray(self.world @ self.changes.joint_in_base[joint - 1])

    def frame(self, name: str, joint: int) -> None:
        """Move a joint's body."""
        if not np.allclose(self.changes.shift[joint - 1], np.eye(4), rtol=0, atol=TOLERANCE):
            self.scene.move(self.scene.body_of(name), self.changes.motion(joint - 1, self.world))
            self.changed.append(f"joint {name}: its body's frame")

    def friction(self, name: str, joint: int) -> None:
        """Set friction, damping and armature."""
        spec_joint, total = self.scene.spec.joint(name), self.options.total
        friction = self.changes.of_joint(Kind.FRICTION, joint)
        damping = self.changes.of_joint(Kind.DAMPING, joint)
        armature = self.changes.of_joint(Kind.ARMATURE, joint)
        if friction:
            spec_joint.frictionloss = total(friction, spec_joint.frictionloss)
            self.changed.append(f"joint {name}: frictionloss {spec_joint.frictionloss:.6g}")
        if damping:
            linear = np.array(spec_joint.damping)
            linear[0] = total(damping, linear[0])
            spec_joint.damping = linear
            self.changed.append(f"joint {name}: damping {linear[0]:.6g}")
        if armature:
            spec_joint.armature = total(armature, spec_joint.armature)
            self.changed.append(f"joint {name}: armature {spec_joint.armature:.6g}")

    def actuator(self, name: str, joint: int) -> None:
        """Set delay, lag and gain of the position actuator of a joint."""
        delay, lag, droop = (
            self.changes.of_joint(kind, joint)
            for kind in (Kind.DELAY, Kind.LAG, Kind.SERVO_COMPLIANCE)
        )
        if not (delay or lag or droop):
            return
        actuators = self.scene.spec.actuators
        actuator = next((a for a in actuators if a.target == name and self._is_position(a)), None)
        if actuator is None:
            self.missing.append(f"delay, lag or gain of {name}: it has no position actuator; put "
                                "them into the controller")  # fmt: skip
            return
        if delay:
            actuator.delay = self.options.total(delay, actuator.delay)
            actuator.interp = LINEAR  # zero-order hold would delay by whole steps only
            actuator.nsample = int(np.ceil(actuator.delay / self.scene.spec.option.timestep)) + 1
            self.changed.append(
                f"actuator of {name}: delay {actuator.delay:.6g} s; after a reset fill its history "
                "with mj_initCtrlHistory, or it drives to 0 for that time"
            )
        if lag:
            filter_type = self.scene.mujoco.mjtDyn.mjDYN_FILTEREXACT
            parameters = np.array(actuator.dynprm)
            on_top = actuator.dyntype == filter_type and self.options.on_top
            earlier = parameters[0] if on_top else 0.0
            # the sampled filter lags half a step less than its time constant
            parameters[0] = lag + (earlier or self.scene.spec.option.timestep / 2)
            actuator.dyntype, actuator.dynprm, actuator.actearly = filter_type, parameters, 1
            self.changed.append(f"actuator of {name}: timeconst {parameters[0]:.6g} s")
        if droop:
            self._soften(actuator, droop)
            self.changed.append(f"actuator of {name}: kp {actuator.gainprm[0]:.6g}")

    def _is_position(self, actuator: Any) -> bool:
        """Return whether an actuator drives a joint to a position, as no motor does."""
        mujoco, kp = self.scene.mujoco, actuator.gainprm[0]
        joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        own = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER,
               mujoco.mjtDyn.mjDYN_FILTEREXACT)  # fmt: skip
        return bool(
            actuator.trntype in joint and actuator.dyntype in own and kp > 0
            and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
            and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
            and actuator.biasprm[1] == -kp and actuator.gear[0]
        )  # fmt: skip

    def _soften(self, actuator: Any, droop: float) -> None:
        """Set the gain of a position actuator so that its joint droops by ``droop`` rad/Nm."""
        gain, bias = np.array(actuator.gainprm), np.array(actuator.biasprm)
        gear2 = float(actuator.gear[0]) ** 2  # the joint's stiffness is kp gear^2
        if self.options.on_top:
            droop += 1 / (gain[0] * gear2)  # in the user's model
        kp = 1 / (droop * gear2)
        if bias[2] < 0:  # positive is a damping ratio, which needs no change
            bias[2] *= np.sqrt(kp / gain[0])
        gain[0], bias[1] = kp, -kp
        actuator.gainprm, actuator.biasprm = gain, bias

    def springs(self, name: str, joint: int) -> None:
        """Add play and springs after a joint: about its axis, then across it."""
        frame = self.joint_in_world(joint)
        origin, axes = frame[:3, 3], frame[:3, :3]
        self._play(name, joint, frame)
        flexibility = self.changes.springs.joint[joint - 1]
        softening = self.changes.springs.softening[joint - 1]
        for k, label in ((2, "axial_compliance"), (0, "radial_x"), (1, "radial_y")):
            c = float(flexibility[k])
            if c <= 0:
                continue
            stiffness: tuple[float, ...] = (1 / c,)
            if k == 2 and softening > 0:
                limit = MOMENT_RANGE * typical_moment(self.changes.model.arm)
                stiffness, error = _stiffening(c, softening, limit)
                if error > TOLERATED:
                    self.missing.append(
                        f"stiffening of {name}: up to {limit:.3g} Nm its cubic spring is up to "
                        f"{percent(error)} of the largest angle off"
                    )
            inertia = self.scene.inertia_about(name, axes[:, k], origin)
            self._add_hinge(name, label, origin, axes[:, k], stiffness=stiffness, inertia=inertia)
            self.changed.append(f"joint {name}_{label}: stiffness {1 / c:.6g} Nm/rad")

    def _play(self, name: str, joint: int, frame: Array) -> None:
        """Add a limited hinge after a joint, and the friction that keeps its play taken up.

        ``frame``: the joint's (4, 4) in world.
        """
        origin, axis = frame[:3, 3], frame[:3, 2]
        half = self.changes.of_joint(Kind.PLAY, joint) / 2
        if not half:
            return
        largest = self.scene.largest_inertia(name)
        friction = PLAY_DECELERATION * largest
        # MuJoCo scales limits and friction by the inertia at its zero pose, which is close to zero
        # about the first axis of an arm that points straight up.
        softness = min(self.scene.inertia_about(name, axis) / largest, 1.0)
        self._add_hinge(name, "backlash", origin, axis, half_range=half, softness=softness)
        self.scene.add_friction_tendon(name, f"{name}_backlash", friction, softness)
        self.changed.append(
            f"joint {name}_backlash: +-{half:.6g} rad; tendon {name}_backlash_friction, "
            f"{friction:.3g} Nm, takes it up against the motion where no load does"
        )

    def _add_hinge(self, name: str, label: str, origin: Array, axis: Array,
                   **settings: Any) -> None:  # fmt: skip
        """Add a hinge after a joint, through the origin (3,) of the cell's joint, in world.

        The model's own joint can be elsewhere on the axis, where an axis across it is another line.
        """
        body = self.scene.body_of(name)
        point, direction = self.scene.point_in(body, origin), self.scene.in_body(body, axis)
        self.scene.add_hinge_after(name, Hinge(f"{name}_{label}", point, direction, **settings))

    def inertial(self, name: str, joint: int) -> None:
        """Scale mass and inertia of a joint's link, and move its centre of gravity.

        A link is the joint's body and all that are fixed to it.
        """
        scale = 1 + self.changes.of_joint(Kind.LINK_SCALE, joint)
        moment = self.changes.vector(Kind.LINK_MOMENT, joint)
        if scale == 1 and not moment.any():
            return
        link = self._link(name, joint)
        if not link:
            self.missing.append(f"inertia of the link of {name}: its bodies have no mass")
            return
        elements = [self.scene.inertial(body) for body in link]
        named = f"body {', '.join(map(_named, link))}"
        if scale != 1:
            for element in elements:
                element.mass *= scale
                element.inertia = np.array(element.inertia) * scale
            self.changed.append(f"{named}: mass and inertia times {scale:.6g}")
        if moment.any():
            in_world = self.joint_in_world(joint)[:3, :3] @ moment
            shift = in_world / sum(element.mass for element in elements)
            for element in elements:
                element.ipos = np.array(element.ipos) + self.scene.in_body(element, shift)
            self.changed.append(f"{named}: centre of gravity")

    def _link(self, name: str, joint: int) -> list[Any]:
        """Return the bodies of a joint's link that have a mass."""
        fixed = self.scene.fixed_to(self.scene.body_of(name), self.options.load or None)
        masses = [self.scene.mass(body) for body in fixed]
        if not self.changes.is_one_link(joint, masses):
            del fixed[1:]
        return [body for body, mass in zip(fixed, masses, strict=False) if mass > 0]

    def base(self) -> None:
        """Insert springs about the base axes before the first joint."""
        springs = self.changes.springs.base
        first = self.scene.body_of(self.names[0])
        anchor = self.scene.point_in(first, self.world[:3, 3])
        hinges = []
        for k, c in enumerate(springs):
            if c > 0:
                axis = self.world[:3, k]
                inertia = self.scene.inertia_about(self.names[0], axis, self.world[:3, 3])
                name = f"base_compliance_{'xyz'[k]}"
                axis_in_body = self.scene.in_body(first, axis)
                hinges.append(Hinge(name, anchor, axis_in_body, (1 / c,), inertia))
                self.changed.append(
                    f"joint {name}: stiffness {1 / c:.6g} Nm/rad, before the first joint"
                )
        if hinges:
            self.scene.insert_body_before(first, "base_compliance", hinges)

    def links(self) -> None:
        """Add link flexibility: two pairs of hinges across the link, each of stiffness 2 EI / L.

        They are at the two Gauss points of its length, so that deflection and slope of its end are
        the cantilever's, for a force and for a moment.
        """
        for i, flexibility in enumerate(self.changes.springs.link[:-1]):
            root, end = self.joint_in_world(i + 1)[:3, 3], self.joint_in_world(i + 2)[:3, 3]
            length = float(np.linalg.norm(end - root))
            if flexibility <= 0 or length == 0:
                continue
            body = self.scene.body_of(self.names[i + 1])
            stiffness = 2 / (length * flexibility)
            name = f"{self.names[i]}_link_flexibility"
            hinges: list[Hinge] = []
            for share in GAUSS:
                point = root + share * (end - root)
                for axis in np.linalg.svd((end - root)[None])[2][1:]:
                    inertia = self.scene.inertia_about(self.names[i + 1], axis, point)
                    hinges.append(Hinge(
                        f"{name}_{len(hinges) + 1}", self.scene.point_in(body, point),
                        self.scene.in_body(body, axis), (stiffness,), inertia,
                    ))  # fmt: skip
            self.scene.insert_body_before(body, name, hinges)
            self.changed.append(
                f"joints {name}_1 to _4: stiffness {stiffness:.6g} Nm/rad across the link"
            )

    def tool(self) -> None:
        """Move the TCP's site."""
        sites = [site.name for site in self.scene.spec.sites]
        tcp = known_name(self.scene.path, "--tcp", self.options.tcp, sites)
        if np.allclose(self.changes.tcp_shift, np.eye(4), rtol=0, atol=TOLERANCE):
            return
        if not tcp:
            listed = ", ".join(sites) or "none"
            self.missing.append(f"tool: name the site of the TCP with --tcp ({listed})")
            return
        site = self.scene.spec.site(tcp)
        frame = self.world @ self.changes.tcp_in_base
        motion = frame @ self.changes.tcp_shift @ np.linalg.inv(frame)
        self._place_site(site, motion @ self._site_in_world(site))
        self.changed.append(f"site {site.name}: TCP")

    def sensor(self) -> None:
        """Turn the site of the flange's force sensor."""
        turn = self.changes.vector(Kind.SENSOR_TURN)
        if not turn.any():
            return
        kinds = (
            self.scene.mujoco.mjtSensor.mjSENS_FORCE,
            self.scene.mujoco.mjtSensor.mjSENS_TORQUE,
        )
        names = {s.objname for s in self.scene.spec.sensors if s.type in kinds}
        if len(names) != 1:
            self.missing.append(
                f"ft_misalignment: found {len(names)} sites with force or torque sensors, expected "
                "one; turn its frame by hand"
            )
            return
        site = self.scene.spec.site(names.pop())
        flange = self.joint_in_world(self.changes.n + 1)[:3, :3]
        pose = self._site_in_world(site)
        pose[:3, :3] = flange @ rotation_matrix(turn) @ flange.T @ pose[:3, :3]
        self._place_site(site, pose)
        self.changed.append(f"site {site.name}: the force sensor's frame")

    def _site_in_world(self, site: Any) -> Array:
        i = self.scene.compiled.site(site.name).id
        data = self.scene.data
        return transform(data.site_xmat[i].reshape(3, 3), data.site_xpos[i])

    def _place_site(self, site: Any, in_world: Array) -> None:
        parent = self.scene.frame(site.parent)
        self.scene.place("site", site, np.linalg.inv(parent) @ in_world)

    def load(self) -> None:
        """Change the body that models the load; where ``--load`` names none, add a mass."""
        named = [body.name for body in self.scene.spec.bodies if body.name]
        load = known_name(self.scene.path, "--load", self.options.load, named)
        extra = sum(s.value for s in self.changes.settings if s.kind is Kind.PAYLOAD)
        shift = self.changes.vector(Kind.PAYLOAD_COG)
        if not extra and not shift.any():
            return
        if load:
            self._change_load(self.scene.spec.body(load), extra, shift)
        elif extra > 0 and not shift.any():
            self._add_load(extra)
        else:
            self.missing.append(
                f"load: {extra:+.6g} kg, centre {1e3 * np.linalg.norm(shift):.4g} mm off: name "
                f"the body that models it with --load ({', '.join(named)})"
            )

    def _change_load(self, body: Any, extra: float, shift: Array) -> None:
        element = self.scene.inertial(body)
        if element.mass + extra <= 0:
            raise InputError(
                f"{self.scene.path}: --load: found {element.mass:.6g} kg in {body.name}, expected "
                f"more than the {-extra:.6g} kg that the load is lighter"
            )
        element.mass += extra
        in_world = self.joint_in_world(self.changes.n + 1)[:3, :3] @ shift
        element.ipos = np.array(element.ipos) + self.scene.in_body(body, in_world)
        if extra:
            self.changed.append(f"body {body.name}: mass {element.mass:.6g} kg")
        if shift.any():
            self.changed.append(f"body {body.name}: centre of gravity")

    def _add_load(self, extra: float) -> None:
        last = self.scene.body_of(self.names[-1])
        flange = self.joint_in_world(self.changes.n + 1)
        centre = flange[:3, :3] @ self.changes.model.payload_cog + flange[:3, 3]
        load = last.add_body(name="payload_difference", pos=self.scene.point_in(last, centre))
        load.explicitinertial, load.mass, load.inertia = True, extra, [POINT_INERTIA] * 3
        load.ipos = np.zeros(3)  # without it MuJoCo's writer leaves the inertial out
        self.changed.append(f"body payload_difference: {extra:.6g} kg")

    def unsupported(self) -> list[str]:
        """Return the changes that are not in the model, with what to do instead."""
        lines = list(self.missing)
        compensated = [b.name for b in self.scene.spec.bodies if b.gravcomp]
        if compensated:
            lines.append(
                f"gravcomp of {', '.join(compensated)} cancels the sag of springs and servos"
            )
        lines += [f"{name}: {text}" for name, text in self.changes.unsupported]
        return [*lines, *self.changes.skipped]
