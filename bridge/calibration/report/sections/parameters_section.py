"""The parameters: values with intervals, what the plan predicted, what cannot be separated."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.figures import decimals_of, estimate_texts, fixed
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.blocks import Block, Bullets, Cell, Heading, Paragraph, Table
from gapbridge.bridge.report.labels import unit_of
from gapbridge.bridge.report.names import parameter_title, with_titles
from gapbridge.core.calibration.result import Estimate


def parameters(material: Material) -> list[Block]:
    """Return the table and what the readings do not determine."""
    c = material.calibration
    shown = [e for e in c.estimates if e.shown]
    hidden = [parameter_title(e.name) for e in c.estimates if not e.shown]
    planned = any(e.expected_std is not None for e in shown)
    blocks: list[Block] = [estimates_table(shown, planned=planned)]
    if any(e.on_bound for e in shown):
        text = "* stands on the bound of what is physically possible."
        blocks.append(Paragraph(text, "note"))
    if c.combinations or hidden:
        blocks.append(Heading("What these readings cannot determine"))
        items = [with_titles(text) for text in c.combinations]
        # the combinations speak of most of them
        items += [
            f"{name}: these readings do not show it; it stays near where it stood"
            for name in hidden
            if not any(text.startswith(name) for text in items)
        ]
        blocks.append(Bullets(tuple(items)))
    return blocks


def estimates_table(shown: list[Estimate], *, planned: bool) -> Table:
    """Return values with intervals; ``planned``: beside what the plan expected."""
    heads: tuple[str, ...]
    if not planned:
        heads = ("parameter", "value", "95 % interval", "1 sigma", "unit")
        return Table(heads, [_row(e) for e in shown], (3.2, 1, 1.8, 1, 0.9), (1, 2, 3))
    heads = ("parameter", "value", "95 % interval", "1 sigma", "1 sigma, as planned", "unit")
    rows = [[*_row(e)[:4], _planned(e), _row(e)[4]] for e in shown]
    return Table(heads, rows, (3.2, 1, 1.8, 0.9, 1.1, 0.9), (1, 2, 3, 4))


def _row(e: Estimate) -> list[Cell]:
    value, interval, std, unit = estimate_texts(e)
    return [parameter_title(e.name) + (" *" if e.on_bound else ""), value, interval, std, unit]


def _planned(e: Estimate) -> str:
    if e.expected_std is None:
        return "–"
    _, factor = unit_of(e.unit)
    return fixed(e.expected_std * factor, decimals_of(e.std * factor))
