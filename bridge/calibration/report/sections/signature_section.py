"""The block that people sign."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.document.blocks import Part, Table

LINE = "_" * 24


def signature(session: SessionFacts) -> Part:
    """Return the last section: who measured, who releases, room for name, date and signature."""
    rows = [
        ["measured by", session.operator or LINE, LINE, LINE],
        ["released by", LINE, LINE, LINE],
    ]
    table = Table(("", "name", "date", "signature"), rows, (1.0, 1.8, 1.8, 1.8))
    number = f" of report {session.number}" if session.number else ""
    about = f"The figures{number} hold for the cell file whose SHA-256 stands under Session."
    return Part("signature", "Signatures", about if session.cell_sha256 else "", (table,))
