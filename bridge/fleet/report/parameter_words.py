"""Parameters in plain words."""

from __future__ import annotations

import re

from gapbridge.bridge.report.labels import CHANNELS, effect_title
from gapbridge.core.effects import CATALOGUE


def parameter_words(name: str) -> str:
    """Return a parameter's name in words: the effect, and the joint or what else it is of."""
    for channel, words in CHANNELS.items():
        if name == f"{channel} gap_rms":
            return f"{words.lower()}: gap"
        if name.startswith(f"{channel}: "):
            return f"{words.lower()}: {name.removeprefix(f'{channel}: ')}"
    effect = next((e for e in sorted(CATALOGUE, key=len, reverse=True) if name.startswith(e)), None)
    if effect is None:
        return name.replace("_", " ")
    rest = name.removeprefix(effect).strip("_").replace("_", " ")
    joint = re.fullmatch(r"(\d+)(.*)", rest)
    if joint and CATALOGUE[effect].flexibility:
        return CATALOGUE[effect].label_words.format(joint=joint[1])
    if joint:
        rest = f"joint {joint[1]}{joint[2]}"
    return f"{effect_title(effect)}{': ' + rest if rest else ''}"


def type_words(name: str) -> str:
    """Return an arm type's name; DH rows have none but a number."""
    return f"Arms of DH rows ({name[3:]})" if name.startswith("dh ") else name
