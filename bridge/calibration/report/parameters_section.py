"""The parameters: values with intervals, what the plan had promised, what cannot be told apart."""

from __future__ import annotations

import re

from bridge.calibration.report.blocks import Block, Bullets, Cell, Heading, Paragraph, Table
from bridge.calibration.report.material import Material
from bridge.calibration.report.section import Section
from bridge.report.words import effect_words, number, unit_of
from core.calibration.result import Estimate


class ParametersSection(Section[Material]):
    """What goes into the model, and how surely."""

    key, title = "parameters", "Parameters of the model"
    about = "What was found of this arm, with 95 % intervals."

    def blocks(self, material: Material) -> list[Block]:
        """Return the table and what the readings do not tell."""
        c = material.calibration
        shown = [e for e in c.estimates if e.shown]
        hidden = [parameter_words(e.name) for e in c.estimates if not e.shown]
        blocks: list[Block] = [
            Table(("parameter", "value", "95 % interval", "1 sigma", "1 sigma, planned", "unit"),
                  [_row(e) for e in shown], (3.2, 1, 1.7, 1, 1.1, 1), (1, 2, 3, 4)),
        ]  # fmt: skip
        if any(e.on_bound for e in shown):
            blocks.append(
                Paragraph("* stands on the bound of what is physically possible.", "note")
            )
        if c.combinations or hidden:
            blocks.append(Heading("What these readings cannot tell"))
            items = list(c.combinations)
            items += [f"{name}: not shown; it stands where it stood" for name in hidden]
            blocks.append(Bullets(tuple(items)))
        return blocks


def parameter_words(name: str) -> str:
    """Return a parameter's public name in words: "joint zero is off, joint 3"."""
    match = re.fullmatch(r"([a-z_]+?)(?:_(\d+))?(?:_([a-z]+(?:_\d+)?))?", name)
    if match is None or effect_words(match[1]) == match[1].replace("_", " "):
        return name
    where = f", joint {match[2]}" if match[2] else ""
    return f"{effect_words(match[1])}{where}{', ' + match[3] if match[3] else ''}"


def _row(e: Estimate) -> list[Cell]:
    unit, factor = unit_of(e.unit)
    low, high = (v * factor for v in e.interval)
    planned = "–" if e.expected_std is None else number(e.expected_std * factor, 2)
    mark = " *" if e.on_bound else ""
    return [
        parameter_words(e.name) + mark, number(e.value * factor),
        f"{number(low)} to {number(high)}", number(e.std * factor, 2), planned, unit,
    ]  # fmt: skip
