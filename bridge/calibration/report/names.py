"""Names of parameters as people say them."""

from __future__ import annotations

import re

from bridge.report.words import effect_words
from core.effects import CATALOGUE

PATTERNS = {
    "joint_offset": "zero of joint {joint}",
    "axial_compliance": "joint {joint}: twist about its axis, per torque",
    "radial_compliance": "joint {joint}: tilt of its axis, per moment",
    "link_flexibility": "link {joint}: bending under load",
    "link_geometry": "link {joint}: {part}",
    "tool_frame": "tool: {part}",
    "backlash": "joint {joint}: play",
    "base_compliance": "foundation: {part}",
    "transmission_error": "joint {joint}: periodic gear error, {part}",
    "tool_tcp": "tool centre point: {part}",
    "payload_mass": "load: mass",
    "payload_cog": "load: centre of gravity, {part}",
    "ft_bias": "sensor reading without load: {part}",
}
PARTS = {
    "a": "length a", "d": "offset d", "alpha": "twist alpha", "beta": "twist beta",
    "x": "x", "y": "y", "z": "z", "rx": "turn about x", "ry": "turn about y", "rz": "turn about z",
    "fx": "force x", "fy": "force y", "fz": "force z",
    "mx": "torque x", "my": "torque y", "mz": "torque z",
}  # fmt: skip


def effect_of(name: str) -> str:
    """Return the effect that a parameter's public name begins with; empty for none."""
    return max((e for e in (*CATALOGUE, *PATTERNS) if name.startswith(e)), key=len, default="")


def parameter_words(name: str) -> str:
    """Return a parameter's public name in words; the name itself where there are none."""
    effect = effect_of(name)
    match = re.fullmatch(r"(?:_(\d+))?(?:_(.+))?", name.removeprefix(effect))
    if not effect or match is None:
        return name
    joint, rest = match[1] or "", match[2] or ""
    part = PARTS.get(rest, re.sub(r"^order(\S+?)_", r"\1 a turn, ", rest).replace("_", " "))
    pattern = PATTERNS.get(effect)
    if pattern is None:
        where = f", joint {joint}" if joint else ""
        return f"{effect_words(effect)}{where}{', ' + part if part else ''}"
    return pattern.format(joint=joint, part=part).rstrip(", :")
