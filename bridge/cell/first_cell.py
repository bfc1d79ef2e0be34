"""The first cell of an arm: a commented file with the values that its controller reports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gapbridge.bridge.cell.document import number_text, one_line
from gapbridge.bridge.cell.robot import DELTAS
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import InputError
from gapbridge.core.rotation import roll_pitch_yaw
from gapbridge.drivers.controller_facts import ControllerFacts


@dataclass(frozen=True)
class InitOptions:
    """The link's keys, and the arm if the controller does not report which it is."""

    link: Mapping[str, Any]
    model: str | None = None
    urdf: str | None = None
    tip: str | None = None  # the URDF's link that is the flange


def first_cell_text(facts: ControllerFacts, options: InitOptions) -> str:
    """Return the text of a cell. Raises InputError if the arm is unknown or contradictory."""
    return "\n".join(
        line
        for part in (_header(facts, options), _robot(facts, options), _tool(facts), _payload(facts),
                     _other_sections(facts, options))
        for line in part
    )  # fmt: skip


def _header(facts: ControllerFacts, options: InitOptions) -> Iterator[str]:
    link = options.link
    where = link.get("host") or link.get("channel") or link.get("serial")
    software = f", software {facts.version}" if facts.version else ""
    yield f"# Written by `gapbridge init` from what the controller at {where} reports{software}."
    yield "# Next: gapbridge check CELL --live, then gapbridge run CELL --observe."
    yield ""


def _robot(facts: ControllerFacts, options: InitOptions) -> Iterator[str]:
    yield "robot:"
    if options.urdf is not None:
        yield f"  urdf: {one_line(options.urdf)}"
        if options.tip is not None:
            yield f"  tip: {one_line(options.tip)}"
    else:
        model = options.model or facts.model
        if model is None:
            raise InputError(
                "--model: found nothing, and the controller does not report which arm it moves; "
                "expected --model (a built-in arm) or --urdf FILE"
            )
        if facts.model is not None and model != facts.model:
            raise InputError(
                f"--model: found {model}, expected {facts.model}, as the controller reports"
            )
        if builtin_arm(model).n != facts.n:
            raise InputError(f"--model: found {model}, expected an arm of {facts.n} joints")
        yield f"  model: {model}"
        if any(np.any(values) for values in facts.calibration.values()):
            yield "  calibration:  # of the factory, from the controller: rad and m per joint"
            for key in DELTAS:
                yield f"    {key}: {_list(facts.calibration[key])}"
        elif not facts.calibration:
            yield "  # the controller does not report its factory calibration; where you have it:"
            yield "  # calibration: calibration.conf"
        yield from _limit_comments(facts, model)
    yield ""


def _limit_comments(facts: ControllerFacts, model: str) -> Iterator[str]:
    known = builtin_arm(model).limits
    if facts.lower is None or facts.upper is None:
        return
    narrow = (facts.lower > known.lower + 1e-3) | (facts.upper < known.upper - 1e-3)
    for joint in np.flatnonzero(narrow):
        yield (
            f"  # joint {joint + 1} is limited to {facts.lower[joint]:.3f} .. "
            f"{facts.upper[joint]:.3f} rad in the controller's safety configuration"
        )


def _tool(facts: ControllerFacts) -> Iterator[str]:
    if facts.tcp is None:
        yield "tool:  # the controller does not report its TCP: fill in yours"
        yield "  tcp: {xyz: [0.0, 0.0, 0.0], rpy: [0.0, 0.0, 0.0]}  # in the flange frame, m, rad"
    else:
        yield "tool:"
        xyz, rpy = _list(facts.tcp[:3, 3]), _list(roll_pitch_yaw(facts.tcp[:3, :3]))
        yield f"  tcp: {{xyz: {xyz}, rpy: {rpy}}}  # in the flange frame, m, rad"
    yield ""


def _payload(facts: ControllerFacts) -> Iterator[str]:
    known = facts.payload is not None
    mass, cog = facts.payload or 0.0, facts.payload_cog if known else None
    text = (
        f"payload: {{mass: {number_text(mass)}, cog: {_list(np.zeros(3) if cog is None else cog)}}}"
    )
    what = "kg, m in the flange frame; tool included"
    yield f"{text}  # {what}" + ("" if known else ": not reported by the controller, fill in yours")
    yield ""


def _other_sections(facts: ControllerFacts, options: InitOptions) -> Iterator[str]:
    gravity = facts.gravity
    if gravity is not None and np.linalg.norm(gravity) > 1.0:
        yield f"gravity: {_list(gravity)}  # m/s2 in base, as the arm is mounted in the controller"
    else:
        yield "gravity: [0.0, 0.0, -9.80665]  # m/s2 in base; turn it for a wall or a ceiling"
    yield from ("", "metrology:", "  registered: false  # an instrument's frame is estimated along")
    yield from ("  sigma: 2.0e-05  # m, 1 sigma of one coordinate of your instrument", "", "link:")
    for key, value in options.link.items():
        yield f"  {key}: {one_line(value)}"
    if facts.rate is not None and "rate" not in options.link:
        yield f"  rate: {number_text(facts.rate)}  # Hz"
    known = None if facts.model is None else builtin_arm(facts.model).limits.velocity
    if facts.velocity is not None and known is not None and (facts.velocity < 0.99 * known).any():
        slow = number_text(float(facts.velocity.min()))
        yield from ("", "limits:", f"  joint_velocity: {slow}  # rad/s, of the controller")
    yield from (
        "",
        "setpoints:",
        "  source: target",
        "  arm: false  # true: `gapbridge run` writes",
    )
    yield from ("", "recording:", "  folder: recordings", "")


def _list(values: Sequence[float] | np.ndarray[Any, Any]) -> str:
    return "[" + ", ".join(number_text(round(float(v), 12) + 0.0) for v in values) + "]"
