"""Names of parameters as people say them."""

from __future__ import annotations

import re

from bridge.report.words import effect_words
from core.effects import CATALOGUE

PATTERNS = {
    "joint_offset": "zero of joint {joint}",
    "axial_compliance": "twist of joint {joint} per torque",
    "radial_compliance": "tilt of joint {joint} per moment",
    "link_flexibility": "bending of link {joint}",
    "link_geometry": "{part} of link {joint}",
    "tool_frame": "tool {part}",
    "backlash": "play of joint {joint}",
    "base_compliance": "yielding of the foundation about {part}",
    "transmission_error": "gear error of joint {joint} ({part})",
    "stiffness_nonlinearity": "stiffening of joint {joint} ({part})",
    "gravity_direction": "tilt of the base about {part}",
    "thermal_drift": "growth of link {joint} with warmth",
    "payload": "mass of the load beyond the declared one",
    "tool_tcp": "tool centre {part}",
    "payload_mass": "mass of the load",
    "payload_cog": "centre of gravity {part}",
    "ft_bias": "sensor zero of {part}",
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
    if name == effect and effect in CATALOGUE and "{" in PATTERNS.get(effect, "{"):
        return effect_words(effect)
    match = re.fullmatch(r"(?:_(\d+))?(?:_(.+))?", name.removeprefix(effect))
    if not effect or match is None:
        return name
    joint, rest = match[1] or "", match[2] or ""
    part = PARTS.get(rest, re.sub(r"^order(\S+?)_", r"\1 a turn, ", rest).replace("_", " "))
    pattern = PATTERNS.get(effect)
    if pattern is None:
        where = f", joint {joint}" if joint else ""
        return f"{effect_words(effect)}{where}{', ' + part if part else ''}"
    return pattern.format(joint=joint, part=part).replace(" ()", "").strip()


def spoken(text: str) -> str:
    """Return a text with public names of parameters and effects in words instead."""
    names = "|".join(sorted((*CATALOGUE, *PATTERNS), key=len, reverse=True))
    return re.sub(rf"\b(?:{names})(?:_[A-Za-z0-9_.]*\w)?\b", _in_words, text)


def sentence(text: str) -> str:
    """Return a text that begins with a capital and ends with a full stop."""
    text = spoken(text).strip()
    end = "" if text.endswith((".", "!", "?")) else "."
    return text[:1].upper() + text[1:] + end


def _in_words(match: re.Match[str]) -> str:
    # words of the language are names too ("payload", "backlash"): only what has a _ is a name
    return parameter_words(match[0]) if "_" in match[0] else match[0]
