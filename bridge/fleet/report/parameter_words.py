"""Parameters in plain words."""

from __future__ import annotations

import re

from bridge.report.words import CHANNELS, EFFECTS

KINDS = {"axial_compliance": "twist of joint", "radial_compliance": "tilt of joint"}


def parameter_words(name: str) -> str:
    """Return a parameter's name in words: the effect, and the joint or what else it is of."""
    match = re.fullmatch(r"(axial_compliance|radial_compliance)_(\d+)", name)
    if match:
        return f"{KINDS[match[1]]} {match[2]} under load"
    for channel, words in CHANNELS.items():
        if name == f"{channel} gap_rms":
            return f"{words.lower()}: gap"
        if name.startswith(f"{channel}: "):
            return f"{words.lower()}: {name.removeprefix(f'{channel}: ')}"
    effect = next((e for e in sorted(EFFECTS, key=len, reverse=True) if name.startswith(e)), None)
    if effect is None:
        return name.replace("_", " ")
    rest = name.removeprefix(effect).strip("_").replace("_", " ")
    joint = re.fullmatch(r"(\d+)(.*)", rest)
    if joint:
        rest = f"joint {joint[1]}{joint[2]}"
    return f"{EFFECTS[effect]}{': ' + rest if rest else ''}"


def type_words(name: str) -> str:
    """Return an arm type's name; DH rows have none but a number."""
    return f"Arms of DH rows ({name[3:]})" if name.startswith("dh ") else name
