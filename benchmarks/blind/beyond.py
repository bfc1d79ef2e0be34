"""What a diagnosis' model truly leaves in regions of joint space that its log did not show.

The accusations are put into the benchmark's own arm, by their names and values; the frame is the
one of the poses in the log. The figure holds the noise, as what is reported does.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.blind import ingredients as put
from benchmarks.blind.bench import Bench
from benchmarks.blind.cases import Static, drawn_case
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.label import Label
from benchmarks.blind.measuring import frame_columns, gap
from benchmarks.blind.mechanics import RealArm, stand

NUMBER = {
    "joint_offset": put.joint_offset,
    "backlash": put.backlash,
}  # effects of one number at a joint
SOFT = {
    "axial_compliance": put.axial_compliance,
    "radial_compliance": put.radial_compliance,
    "link_flexibility": put.link_flexibility,
}
WIDE = np.inf


def true_beyond(label: Label, causes: list[dict[str, Any]]) -> float | None:
    """Return what remains on the poses kept back (m rms per coordinate, noise included).

    None where the case kept none back, or an accusation is of an effect unknown here.
    """
    case, _ = drawn_case(label.kind, label.seed)
    if not isinstance(case, Static) or case.drawn.bench.fresh is None:
        return None
    bench, fresh = case.drawn.bench, case.drawn.bench.fresh
    model = believed(bench, causes)
    if model is None:
        return None
    left = {}
    for name, session in (("log", bench.session), ("fresh", fresh)):
        real, wanted = stand(case.drawn.real, session), stand(model, session)
        left[name] = gap(real, wanted)[:, :3], frame_columns(wanted, with_rotation=False)
    shown, columns = left["log"]
    away, there = left["fresh"]
    if not bench.instrument.registered:
        frame = np.linalg.lstsq(columns, shown.ravel(), rcond=None)[0]
        away = away - (there @ frame).reshape(-1, 3)
    return float(np.sqrt(np.mean(away**2) + bench.floor**2))


def believed(bench: Bench, causes: list[dict[str, Any]]) -> RealArm | None:
    """Return the nominal arm with the accused effects in it; None where one is unknown here."""
    arm = bench.nominal
    for cause in causes:
        values = {
            str(p["name"]): float(p["value"])
            for p in cause.get("parameters") or []
            if p.get("value") is not None
        }
        parts = _parts(str(cause["effect"]), values)
        if parts is None:
            return None
        for part in parts:
            if part.effect == "stiffness_nonlinearity":  # it stands instead of the linear part
                assert part.joint is not None
                axial = arm.axial.copy()
                axial[part.joint - 1] = 0.0
                arm = replace(arm, axial=axial)
            arm = part.apply(arm)
    return arm


def _parts(effect: str, values: dict[str, float]) -> list[Ingredient] | None:
    rest = {n.removeprefix(effect).strip("_"): v for n, v in values.items()}
    if effect in NUMBER:
        return [NUMBER[effect](int(j), v) for j, v in rest.items()]
    if effect in SOFT:
        return [SOFT[effect](int(j), v, WIDE) for j, v in rest.items()]
    if effect == "tool_frame":
        six = np.array([rest.get(k, 0.0) for k in ("x", "y", "z", "rx", "ry", "rz")])
        return [put.tool_frame(six[:3], six[3:])]
    if effect == "payload":
        return [put.payload(values["payload"], WIDE)]
    if effect == "thermal_drift":
        return [put.thermal_drift(values["thermal_drift"])]
    if effect == "base_compliance":
        return [put.base_compliance(rest.get("x", 0.0), rest.get("y", 0.0), WIDE)]
    if effect == "gravity_direction":
        return [put.gravity_direction(rest.get("x", 0.0), rest.get("y", 0.0))]
    if effect in ("target_slip", "payload_cog"):
        three = np.array([rest.get(k, 0.0) for k in "xyz"])
        if effect == "payload_cog":
            return [put.payload_cog(three, WIDE)]
        return [put.target_slip(three, rest["time"])] if "time" in rest else None
    return _of_joints(effect, rest)


def _of_joints(effect: str, rest: dict[str, float]) -> list[Ingredient] | None:
    """Return the parts of effects with several numbers a joint, named ``JOINT_KEY``."""
    joints: dict[int, dict[str, float]] = {}
    for name, value in rest.items():
        joint, _, key = name.partition("_")
        joints.setdefault(int(joint), {})[key] = value
    if effect == "link_geometry":
        return [put.link_geometry(j, own) for j, own in joints.items()]
    if effect == "stiffness_nonlinearity":
        return [put.stiffness_nonlinearity(j, own["compliance"], own["moment"], WIDE)
                for j, own in joints.items()]  # fmt: skip
    if effect == "joint_slip":
        if any("time" not in own for own in joints.values()):
            return None
        return [put.joint_slip(j, own[""], own["time"]) for j, own in joints.items()]
    if effect != "transmission_error":
        return None
    out = []
    for joint, own in joints.items():
        for name, value in own.items():
            line = re.fullmatch(r"order_?([0-9.]+)_amplitude", name)
            if line:
                phase = own[name.replace("amplitude", "phase")]
                out.append(put.transmission_error(joint, float(line[1]), value, phase))
    return out
