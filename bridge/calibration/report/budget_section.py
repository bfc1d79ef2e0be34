"""The uncertainty budget, in the manner of the GUM."""

from __future__ import annotations

import math

from bridge.calibration.report.blocks import Bar, Block, Bullets, Cell, Heading, Table
from bridge.calibration.report.material import Material
from bridge.calibration.report.section import Section
from bridge.report.words import number, told
from core.calibration.budget import Budget, Input


class BudgetSection(Section[Material]):
    """How surely the tool is where the model puts it."""

    key, title = "uncertainty", "Uncertainty"
    about = "How surely the tool is where the calibrated model puts it, along one axis."

    def blocks(self, material: Material) -> list[Block]:
        """Return the budget and what it leaves out."""
        given = material.budget
        blocks: list[Block] = [_table(given)]
        if given.missing:
            blocks += [Heading("Not in the budget"), Bullets(given.missing)]
        return blocks


def _table(given: Budget) -> Table:
    rows: list[list[Cell]] = [_row(i, given.combined) for i in given.inputs]
    rows.append(["combined standard uncertainty", "", "", "", "", _freedom(given.freedom),
                 told(given.combined, "m"), ""])  # fmt: skip
    rows.append(["expanded uncertainty, k = 2", "", "", "", "", "",
                 told(given.expanded, "m"), ""])  # fmt: skip
    heads = ("input", "type", "distribution", "standard uncertainty", "sensitivity",
             "degrees of freedom", "contribution", "share")  # fmt: skip
    return Table(heads, rows, (2.4, 0.6, 1.1, 1.2, 1.2, 0.9, 1.1, 1.3), (3, 4, 5, 6), sums=2)


def _row(i: Input, combined: float) -> list[Cell]:
    share = (i.contribution / combined) ** 2 if combined else 0.0
    sensitivity = "1" if i.unit == "m" else f"{number(i.sensitivity * 1e3)} mm/{i.unit}"
    return [
        i.name, i.kind, i.distribution, told(i.std, i.unit), sensitivity, _freedom(i.freedom),
        told(i.contribution, "m"), Bar(share, f"{share * 100:.0f} %"),
    ]  # fmt: skip


def _freedom(freedom: float) -> str:
    return f"{freedom:.0f}" if math.isfinite(freedom) else "∞"
