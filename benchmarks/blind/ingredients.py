"""The thirteen effects of the position channel as truth: how each changes the real arm.

An ingredient is one effect at one joint (or none) with its parameter values under the program's
names. ``apply`` turns a real arm into one that has it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.blind.mechanics import Array, RealArm, Row, Session, turn
from benchmarks.blind.session import play

Change = Callable[[RealArm, Array], RealArm]


@dataclass(frozen=True)
class Ingredient:
    """One effect at one place. ``amount`` marks the values that grow with its size."""

    effect: str
    joint: int | None  # from 1
    names: tuple[str, ...]
    values: tuple[float, ...]
    amount: tuple[bool, ...]
    limit: tuple[float, ...]  # largest credible size of each value
    change: Change

    def apply(self, arm: RealArm, values: Array | None = None) -> RealArm:
        """Return the arm with this effect in it."""
        return self.change(arm, np.array(self.values if values is None else values, dtype=float))

    def scaled(self, factor: float) -> Ingredient:
        """Return the same effect, ``factor`` times as large."""
        values = tuple(
            v * factor if a else v for v, a in zip(self.values, self.amount, strict=True)
        )
        return replace(self, values=values)

    def credible(self) -> bool:
        """Return whether no value passes its limit."""
        return all(abs(v) <= m for v, m in zip(self.values, self.limit, strict=True))


def _at_row(arm: RealArm, i: int, make: Callable[[Row], Row]) -> RealArm:
    rows = list(arm.rows)
    rows[i] = make(rows[i])
    return replace(arm, rows=tuple(rows))


def _plus(values: Array, i: int, more: float) -> Array:
    out = values.copy()
    out[i] += more
    return out


def _with_angle(arm: RealArm, joint: int, error: Callable[[Session], Array]) -> RealArm:
    def full(session: Session) -> Array:
        out = np.zeros_like(session.q)
        out[:, joint] = error(session)
        return out

    return replace(arm, angle_errors=(*arm.angle_errors, full))


def joint_offset(joint: int, value: float) -> Ingredient:
    """Return a zero error: true angle = encoder + value (rad)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return _at_row(arm, joint - 1, lambda r: replace(r, offset=r.offset + v[0]))

    return Ingredient("joint_offset", joint, (f"joint_offset_{joint}",), (value,), (True,),
                      (0.05,), change)  # fmt: skip


GEOMETRY = {"a": 0.01, "d": 0.01, "alpha": 0.03, "beta": 0.03}


def link_geometry(joint: int, values: dict[str, float]) -> Ingredient:
    """Return other a, d, alpha, beta of a link."""
    keys = tuple(values)

    def change(arm: RealArm, v: Array) -> RealArm:
        more = dict(zip(keys, v, strict=True))
        return _at_row(
            arm,
            joint - 1,
            lambda r: replace(r, **{k: getattr(r, k) + x for k, x in more.items()}),
        )

    names = tuple(f"link_geometry_{joint}_{k}" for k in keys)
    return Ingredient("link_geometry", joint, names, tuple(values.values()), (True,) * len(keys),
                      tuple(GEOMETRY[k] for k in keys), change)  # fmt: skip


def tool_frame(shift: Array, rotation: Array) -> Ingredient:
    """Return a TCP that sits elsewhere (flange axes)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(
            arm,
            tool_position=arm.tool_position + v[:3],
            tool_rotation=turn(v[None, 3:])[0] @ arm.tool_rotation,
        )

    names = tuple(f"tool_frame_{k}" for k in ("x", "y", "z", "rx", "ry", "rz"))
    return Ingredient("tool_frame", None, names, (*map(float, shift), *map(float, rotation)),
                      (True,) * 6, (0.02,) * 3 + (0.1,) * 3, change)  # fmt: skip


def transmission_error(joint: int, order: float, amplitude: float, phase: float) -> Ingredient:
    """Return a periodic angle error: + amplitude sin(order q + phase)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        def wave(s: Session) -> Array:
            return np.asarray(v[0] * np.sin(order * s.q[:, joint - 1] + v[1]))

        return _with_angle(arm, joint - 1, wave)

    stem = f"transmission_error_{joint}_order{order:g}"
    return Ingredient("transmission_error", joint, (f"{stem}_amplitude", f"{stem}_phase"),
                      (amplitude, phase), (True, False), (0.005, 10.0), change)  # fmt: skip


def axial_compliance(joint: int, value: float, limit: float) -> Ingredient:
    """Return a joint soft about its axis (rad/Nm)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(arm, axial=_plus(arm.axial, joint - 1, v[0]))

    return Ingredient("axial_compliance", joint, (f"axial_compliance_{joint}",), (value,), (True,),
                      (limit,), change)  # fmt: skip


def radial_compliance(joint: int, value: float, limit: float) -> Ingredient:
    """Return a joint soft across its axis (rad/Nm)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(arm, radial=_plus(arm.radial, joint - 1, v[0]))

    return Ingredient("radial_compliance", joint, (f"radial_compliance_{joint}",), (value,),
                      (True,), (limit,), change)  # fmt: skip


def link_flexibility(joint: int, value: float, limit: float) -> Ingredient:
    """Return a link that bends: 1/EI."""

    def change(arm: RealArm, v: Array) -> RealArm:
        now = np.zeros(arm.n) if arm.link_softness is None else arm.link_softness
        return replace(arm, link_softness=_plus(now, joint - 1, v[0]))

    return Ingredient("link_flexibility", joint, (f"link_flexibility_{joint}",), (value,), (True,),
                      (limit,), change)  # fmt: skip


def stiffness_nonlinearity(joint: int, soft: float, knee: float, limit: float) -> Ingredient:
    """Return a joint that stiffens: theta = c M / sqrt(1 + (M / M0)^2)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(arm, deflected={**arm.deflected, joint - 1: (float(v[0]), float(v[1]))})

    stem = f"stiffness_nonlinearity_{joint}"
    return Ingredient("stiffness_nonlinearity", joint, (f"{stem}_compliance", f"{stem}_moment"),
                      (soft, knee), (True, False), (limit, np.inf), change)  # fmt: skip


def base_compliance(x: float, y: float, limit: float) -> Ingredient:
    """Return a foundation that tilts about x and y of base under its moment."""

    def change(arm: RealArm, v: Array) -> RealArm:
        old = arm.base_softness
        return replace(arm, base_softness=(old[0] + float(v[0]), old[1] + float(v[1])))

    return Ingredient("base_compliance", None, ("base_compliance_x", "base_compliance_y"), (x, y),
                      (True, True), (limit, limit), change)  # fmt: skip


def gravity_direction(x: float, y: float) -> Ingredient:
    """Return a base that is not level: gravity turned about x and y of base."""

    def change(arm: RealArm, v: Array) -> RealArm:
        base_rotation = turn(np.array([[v[0], v[1], 0.0]]))[0]
        return replace(arm, gravity=base_rotation @ arm.gravity)

    return Ingredient("gravity_direction", None, ("gravity_direction_x", "gravity_direction_y"),
                      (x, y), (True, True), (0.2, 0.2), change)  # fmt: skip


def joint_slip(joint: int, value: float, moment: float) -> Ingredient:
    """Return a joint whose zero steps by a value (rad) at a moment (s)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return _with_angle(arm, joint - 1, lambda s: np.where(s.time >= moment, float(v[0]), 0.0))

    names = (f"joint_slip_{joint}", f"joint_slip_{joint}_time")
    return Ingredient(
        "joint_slip", joint, names, (value, moment), (True, False), (0.1, np.inf), change
    )


def target_slip(shift: Array, moment: float) -> Ingredient:
    """Return a target that moves on the tool at a moment (s), flange axes."""

    def change(arm: RealArm, v: Array) -> RealArm:
        def moved(session: Session, down: Array) -> Array:
            return np.where((session.time >= moment)[:, None], v[:3], 0.0)

        return replace(arm, tool_shifts=(*arm.tool_shifts, moved))

    names = (*(f"target_slip_{k}" for k in "xyz"), "target_slip_time")
    return Ingredient(
        "target_slip", None, names, (*map(float, shift), moment), (True,) * 3 + (False,),
        (0.1,) * 3 + (np.inf,), change,
    )  # fmt: skip


def payload_cog(shift: Array, limit: float) -> Ingredient:
    """Return a load whose centre of gravity is elsewhere (flange axes)."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(arm, payload_shift=arm.payload_shift + v)

    names = tuple(f"payload_cog_{k}" for k in "xyz")
    values = tuple(map(float, shift))
    return Ingredient("payload_cog", None, names, values, (True,) * 3, (limit,) * 3, change)


def payload(value: float, limit: float) -> Ingredient:
    """Return a load that weighs more than declared."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(arm, more_payload=arm.more_payload + float(v[0]))

    return Ingredient("payload", None, ("payload",), (value,), (True,), (limit,), change)


def backlash(joint: int, gap: float) -> Ingredient:
    """Return play in a joint, with memory."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return _with_angle(arm, joint - 1, lambda s: play(s, joint - 1, float(v[0])))

    return Ingredient("backlash", joint, (f"backlash_{joint}",), (gap,), (True,), (0.01,), change)


def thermal_drift(value: float) -> Ingredient:
    """Return links that grow with their joints' temperatures."""

    def change(arm: RealArm, v: Array) -> RealArm:
        return replace(arm, expansion=arm.expansion + float(v[0]))

    return Ingredient("thermal_drift", None, ("thermal_drift",), (value,), (True,), (3e-4,), change)
