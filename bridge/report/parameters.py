"""Section of parameters with their intervals, ties, and the next measurements."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.numbers import decimals_of, fixed, number
from gapbridge.bridge.document.provenance import HALF_WIDTH
from gapbridge.bridge.report.labels import effect_title, joint_list, listed, parameter_unit
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.slips import moment_of
from gapbridge.core.diagnosis.causes import Cause
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.diagnosis.separation import Measurement
from gapbridge.core.effects import Reported

SHOWN = 12


def parameters(material: Material) -> list[blocks.Block]:
    """Return the parameters, the ties and the next measurements."""
    causes = [c for channel in material.diagnosis.channels for c in channel.causes]
    return [
        *_parameters(causes, material.diagnosis), *_ties(causes),
        blocks.Heading("What to measure next"),
        *_next(material.diagnosis.next_measurements),
    ]  # fmt: skip


def _parameters(causes: list[Cause], diagnosis: Diagnosis) -> list[blocks.Block]:
    if not causes:
        return [
            blocks.Paragraph("No cause was named, so there are no parameters to add to the model.")
        ]
    rows: list[list[blocks.Cell]] = []
    for cause in causes:
        where = f", {joint_list(cause.joints)}" if cause.joints else ""
        first: blocks.Cell = blocks.Named(effect_title(cause.effect), where)
        for p in cause.parameters:
            rows.append([first, blocks.Named("", code=p.name), *_value(p, diagnosis)])
            first = ""
    note = (
        "Each value is what the real arm has more than the model; the interval contains the true "
        "value in 19 of 20 cases."
    )
    heads = ("cause", "parameter", "value", "95 % interval", "unit")
    return [blocks.Table(heads, rows, (2.2, 2.2, 1, 1.6, 0.8)), blocks.Paragraph(note, "note")]


def _value(p: Reported, diagnosis: Diagnosis) -> tuple[str, str, str]:
    if p.session:
        return f"first in session {p.session}", "no common clock", ""
    if p.is_time:
        return moment_of(p, diagnosis), "between two rows of the log", ""
    name, factor = parameter_unit(p)
    value = p.value * factor
    if p.std is None or not np.isfinite(p.std):
        return number(value), "unknown", name
    half = HALF_WIDTH * p.std * factor
    digits = decimals_of(half)
    low, high = (fixed(v, digits) for v in (value - half, value + half))
    return fixed(value, digits), f"{low} to {high}", name


def _ties(causes: list[Cause]) -> list[blocks.Block]:
    ties = tuple(
        f"{effect_title(c.effect).capitalize()} ({c.effect}) explains these data no better than "
        f"{listed([f'{effect_title(n)} ({n})' for n in c.indistinguishable_from], 'or')}. "
        "The simpler or likelier one is named; a measurement below would decide between them."
        for c in causes if c.indistinguishable_from
    )  # fmt: skip
    return [blocks.Heading("What these data cannot separate"), blocks.Bullets(ties)] if ties else []


def _next(measurements: tuple[Measurement, ...]) -> list[blocks.Block]:
    if not measurements:
        text = "No further pose or load would decide between the effects."
        return [blocks.Paragraph(text)]
    moving = any(m.velocity for m in measurements)
    text = (
        "Move to these poses with these loads and add the rows to the log"
        f"{'; record a motion through those with a speed' if moving else ''}. Check each for free "
        "space first: they keep to the joint limits and clear of the arm itself, by a coarse shape "
        "of it and its tool; what stands around it is not known here."
    )
    content: list[blocks.Block] = [blocks.Paragraph(text), measurements_table(measurements, SHOWN)]
    more = len(measurements) - SHOWN
    return (
        [*content, blocks.Paragraph(f"{more} more are in the JSON.", "note")]
        if more > 0
        else content
    )


def measurements_table(measurements: tuple[Measurement, ...], most: int) -> blocks.Table:
    """Return a table of next measurements; speeds and approaches only where there are any."""
    shown = measurements[:most]
    columns: list[tuple[str, float, list[blocks.Cell]]] = [
        ("", 0.3, [str(i) for i in range(1, len(shown) + 1)]),
        ("joint angles (deg)", 2.6, [_degrees(m.q, 1) for m in shown]),
    ]
    if any(m.approach for m in shown):
        columns.append(("last motion of each joint", 1.2, [_approach(m) for m in shown]))
    if any(m.velocity for m in shown):
        columns.append(("in motion (deg/s; deg/s²)", 2.2, [_motion(m) for m in shown]))
    columns += [
        ("load (kg)", 0.7, [number(m.payload) for m in shown]),
        ("decides", 2.4, [_purpose(m) for m in shown]),
        ("expected difference", 1.2, [f"{number(m.expected_gain, 2)} × noise" for m in shown]),
    ]
    heads, widths, cells = zip(*columns, strict=True)
    return blocks.Table(heads, list(zip(*cells, strict=True)), widths)


def _approach(m: Measurement) -> str:
    return " ".join({1: "+", -1: "−"}.get(a, "0") for a in m.approach or ()) or "any"


def _degrees(values: tuple[float, ...], digits: int) -> str:
    angles = (f"{v + 0.0:.{digits}f}" for v in np.rad2deg(values).round(digits))
    return ", ".join(angles).replace("-", "−")


def _motion(m: Measurement) -> str:
    if m.velocity is None or m.acceleration is None:
        return "at rest"
    return f"{_degrees(m.velocity, 0)}; {_degrees(m.acceleration, 0)}"


def _purpose(m: Measurement) -> str:
    names = [effect_title(n) for n in m.separates]
    if len(names) > 1:
        return f"whether it is “{names[0]}” or “{names[1]}”"
    return f"would show “{names[0]}”"
