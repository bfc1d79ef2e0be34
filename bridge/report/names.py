"""Names of parameters as people say them."""

from __future__ import annotations

import re

from gapbridge.bridge.report.labels import effect_title
from gapbridge.core.effects import CATALOGUE

OF_SESSIONS = {  # what sessions find that is no effect
    "tool_tcp": "tool centre {part}",
    "payload_mass": "mass of the load",
    "payload_cog": "centre of gravity {part}",
}
PARTS = {
    "a": "length a", "d": "offset d", "alpha": "twist alpha", "beta": "twist beta",
    "x": "x", "y": "y", "z": "z", "rx": "turn about x", "ry": "turn about y", "rz": "turn about z",
    "fx": "force x", "fy": "force y", "fz": "force z",
    "mx": "torque x", "my": "torque y", "mz": "torque z",
}  # fmt: skip


def patterns() -> dict[str, str]:
    """Return how parameters are named in words, by the beginning of their public name."""
    templates = {name: e.label_template for name, e in CATALOGUE.items()}
    return {name: text for name, text in templates.items() if text} | OF_SESSIONS


def effect_of(name: str) -> str:
    """Return the effect that a parameter's public name begins with; empty for none."""
    return max((e for e in (*CATALOGUE, *OF_SESSIONS) if name.startswith(e)), key=len, default="")


def parameter_title(name: str) -> str:
    """Return a parameter's public name in words; the name itself where there are none."""
    effect = effect_of(name)
    if name == effect and effect in CATALOGUE and "{" in patterns().get(effect, "{"):
        return effect_title(effect)
    match = re.fullmatch(r"(?:_(\d+))?(?:_(.+))?", name.removeprefix(effect))
    if not effect or match is None:
        return name
    joint, rest = match[1] or "", match[2] or ""
    part = PARTS.get(rest, re.sub(r"^order(\S+?)_", r"\1 a turn, ", rest).replace("_", " "))
    pattern = patterns().get(effect)
    if pattern is None:
        where = f", joint {joint}" if joint else ""
        return f"{effect_title(effect)}{where}{', ' + part if part else ''}"
    return pattern.format(joint=joint, part=part).replace(" ()", "").strip()


def with_titles(text: str) -> str:
    """Return a text with public names of parameters and effects in words instead."""
    names = "|".join(sorted((*CATALOGUE, *OF_SESSIONS), key=len, reverse=True))
    return re.sub(rf"\b(?:{names})(?:_[A-Za-z0-9_.]*\w)?\b", _as_title, text)


def sentence(text: str) -> str:
    """Return a text that begins with a capital and ends with a full stop."""
    text = with_titles(text).strip()
    end = "" if text.endswith((".", "!", "?")) else "."
    return text[:1].upper() + text[1:] + end


def _as_title(match: re.Match[str]) -> str:
    # words of the language are names too ("payload", "backlash"): only what has a _ is a name
    return parameter_title(match[0]) if "_" in match[0] else match[0]
