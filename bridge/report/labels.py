"""Titles of effects, quantities and parameters, for reports."""

from __future__ import annotations

import math

from gapbridge.bridge.document.numbers import unit_of
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.effects import CATALOGUE, ParameterName, Reported, split_name
from gapbridge.core.log.columns import COLUMNS, INDEXED

CHANNELS = {
    "position": "Position of the tool",
    "wrench": "Force at the flange",
    "tracking": "Following the command",
    "torque": "Joint torques",
}
VERDICTS = {
    Verdict.NO_GAP: "No gap",
    Verdict.EXPLAINED: "Explained",
    Verdict.PARTLY_EXPLAINED: "Partly explained",
    Verdict.UNEXPLAINED: "Unexplained",
}
DEGREES = ("deg", 180 / math.pi)
_QUANTITIES: dict[str, tuple[str, str, float]] = {  # of a column: title, unit, factor from SI
    "timestamp": ("time", "s", 1.0),
    "payload": ("declared load", "kg", 1.0),
    "actual_q": ("angle of joint", *DEGREES),
    "target_q": ("commanded angle of joint", *DEGREES),
    "actual_qd": ("speed of joint", "rad/s", 1.0),
    "joint_temperatures": ("temperature of joint", "°C", 1.0),
    "approach": ("last motion of joint", "", 1.0),
    "held_torque": ("torque held by joint", "Nm", 1.0),
    "payload_cog": ("centre of gravity of the load", "mm", 1e3),
    "measured_position": ("measured position", "mm", 1e3),
    "actual_TCP_force": ("outside force", "N", 1.0),
    "ft_raw_wrench": ("sensor reading", "", 1.0),
}
_AXES = ("x", "y", "z", "about x", "about y", "about z")
SESSION_PARAMETERS = {  # of calibration sessions, beyond those of effects
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


def effect_title(identifier: str) -> str:
    """Return the title of an effect; without one its identifier with spaces."""
    effect = CATALOGUE.get(identifier)
    return (effect.title if effect else "") or identifier.replace("_", " ")


def quantity_title(name: str) -> str:
    """Return the title of a log column, joints counted from 1."""
    stem, index = _column(name)
    if stem not in _QUANTITIES:
        return name.replace("_", " ")
    title = _QUANTITIES[stem][0]
    if index is None:
        return title
    if _is_torque(stem, index):
        title = title.replace("force", "torque")
    return f"{title} {_AXES[index]}" if COLUMNS.get(stem) else f"{title} {index + 1}"


def quantity_unit(name: str) -> tuple[str, float]:
    """Return the display unit of a log column, and the factor from SI."""
    stem, index = _column(name)
    _, unit, factor = _QUANTITIES.get(stem, ("", "", 1.0))
    return ("Nm" if _is_torque(stem, index) else unit), factor


def _is_torque(stem: str, index: int | None) -> bool:
    """Return whether a column is a torque of the outside wrench."""
    return stem == "actual_TCP_force" and (index or 0) >= 3


def _column(name: str) -> tuple[str, int | None]:
    """Return a column's name without its index, and the index."""
    match = INDEXED.match(name)
    return (match[1], int(match[2])) if match else (name, None)


def parameter_unit(parameter: Reported) -> tuple[str, float]:
    """Return the display unit of a parameter, and the factor from SI."""
    return DEGREES if parameter.part == "phase" else unit_of(parameter.unit)


def listed(items: list[str], last: str = "and") -> str:
    """Return items joined with commas, and ``last`` before the last one."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"


def joint_list(joints: tuple[int, ...]) -> str:
    """Return "joint 2" or "joints 2 and 3"; empty for none."""
    if not joints:
        return ""
    return f"joint{'s' if len(joints) > 1 else ''} {listed([str(j) for j in joints])}"


def parameter_title(name: str) -> str:
    """Return the title of a parameter or an effect by its public name; other text unchanged."""
    parts = split_name(name, SESSION_PARAMETERS)
    if parts is None:
        return name
    effect = CATALOGUE.get(parts.effect)
    pattern = SESSION_PARAMETERS.get(parts.effect) or (effect.label_template if effect else "")
    if effect and name == parts.effect and (not pattern or "{" in pattern):
        return effect_title(name)
    joint, part = "" if parts.joint is None else str(parts.joint), _part_title(parts)
    if not pattern:
        pattern = "{effect}" + ", joint {joint}" * bool(joint) + ", {part}" * bool(part)
    text = pattern.format(effect=effect_title(parts.effect), joint=joint, part=part)
    return text.replace(" ()", "").strip()


def _part_title(name: ParameterName) -> str:
    order = "" if name.order is None else f"{name.order:g} a turn, "
    return order + PARTS.get(name.part, name.part.replace("_", " "))


def sentence(text: str) -> str:
    """Return a text that begins with a capital and ends with a full stop."""
    text = text.strip()
    end = "" if text.endswith((".", "!", "?")) else "."
    return text[:1].upper() + text[1:] + end


def counted(count: int, one: str, many: str = "") -> str:
    """Return "1 pose" or "3 poses"."""
    return f"{count} {one if count == 1 else many or one + 's'}"
