"""Parameters with their intervals, ties in plain words, and what to measure next."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.report.fragment import Cell, Raw, bullets, heading, html_of, paragraph, table
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.words import effect_words, joints_words, listed, number, unit_of
from gapbridge.core.diagnosis.result import Cause
from gapbridge.core.diagnosis.separation import Measurement
from gapbridge.core.effects import Reported

SIDE = 1.96  # standard deviations of a 95 % interval
SHOWN = 12


def section(material: Material) -> str:
    """Return the parameters, the ties and the next measurements."""
    causes = [c for channel in material.diagnosis.channels for c in channel.causes]
    return "".join(
        [_parameters(causes), _ties(causes), _next(material.diagnosis.next_measurements)]
    )


def _parameters(causes: list[Cause]) -> str:
    if not causes:
        return paragraph("No effect was accused, so there are no parameters to add to the model.")
    rows: list[list[Cell]] = []
    for cause in causes:
        where = f", {joints_words(cause.joints)}" if cause.joints else ""
        first: Cell = Raw(f"<b>{html_of(effect_words(cause.effect))}</b>{where}")
        for p in cause.parameters:
            rows.append([first, Raw(f"<code>{html_of(p.name)}</code>"), *_value(p)])
            first = ""
    note = (
        "Each is what the real arm has more than the model; the interval holds it in 19 of 20 "
        "cases."
    )
    return table(("cause", "parameter", "value", "95 % interval", "unit"), rows) + paragraph(
        note, "note"
    )


def _value(p: Reported) -> tuple[str, str, str]:
    name, factor = unit_of(p.unit)
    if p.name.endswith("_phase"):
        name, factor = "deg", float(180 / np.pi)
    value = p.value * factor
    if p.std is None or not np.isfinite(p.std):
        return number(value), "unknown", name
    side = SIDE * p.std * factor
    digits = _decimals(side)
    return (
        f"{value:.{digits}f}".replace("-", "−"),
        f"{value - side:.{digits}f} to {value + side:.{digits}f}".replace("-", "−"), name,
    )  # fmt: skip


def _decimals(side: float) -> int:
    """Return the decimals that show two digits of an interval's half width."""
    if side <= 0:
        return 3
    return int(min(max(1 - np.floor(np.log10(side)), 0), 9))


def _ties(causes: list[Cause]) -> str:
    told = [
        f"{effect_words(c.effect).capitalize()} ({c.effect}) explains these data no better than "
        f"{listed([f'{effect_words(n)} ({n})' for n in c.indistinguishable_from], 'or')}. "
        "The simpler or likelier one is named; a measurement below would decide."
        for c in causes if c.indistinguishable_from
    ]  # fmt: skip
    return heading("What these data cannot separate") + bullets(told) if told else ""


def _next(measurements: tuple[Measurement, ...]) -> str:
    head = heading("What to measure next")
    if not measurements:
        return head + paragraph(
            "No question is open that another pose under another load would settle."
        )
    approach, moving = (
        any(m.approach for m in measurements),
        any(m.velocity for m in measurements),
    )
    rows = []
    for i, m in enumerate(measurements[:SHOWN], start=1):
        row: list[Cell] = [str(i), _degrees(m.q, 1), number(m.payload),
                           _purpose(m), f"{number(m.expected_gain, 2)} × noise"]  # fmt: skip
        if moving:
            row.insert(2, _motion(m))
        if approach:
            signs = " ".join({1: "+", -1: "−"}.get(a, "0") for a in m.approach or ())
            row.insert(2, signs or "any")
        rows.append(row)
    heads = ["", "joint angles (deg)", "load (kg)", "decides", "expected difference"]
    if moving:
        heads.insert(2, "in motion (deg/s; deg/s²)")
    if approach:
        heads.insert(2, "reach each joint from")
    text = (
        "Move to these poses with these loads and add the rows to the log"
        f"{'; record a motion through those with a speed' if moving else ''}. Check each for free "
        "space first: the poses keep the joint limits, but nothing here knows your cell."
    )
    more = len(measurements) - SHOWN
    end = paragraph(f"{more} more stand in the JSON.", "note") if more > 0 else ""
    return head + paragraph(text) + table(heads, rows) + end


def _degrees(values: tuple[float, ...], digits: int) -> str:
    told = (f"{v + 0.0:.{digits}f}" for v in np.rad2deg(values).round(digits))
    return ", ".join(told).replace("-", "−")


def _motion(m: Measurement) -> str:
    if m.velocity is None or m.acceleration is None:
        return "at rest"
    return f"{_degrees(m.velocity, 0)}; {_degrees(m.acceleration, 0)}"


def _purpose(m: Measurement) -> str:
    names = [effect_words(n) for n in m.separates]
    if len(names) > 1:
        return f"whether it is “{names[0]}” or “{names[1]}”"
    return f"would show “{names[0]}”"
