"""The first sheet of an .xlsx workbook as rows of text: enough for a table of numbers."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZipFile

MAIN = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"


def read_sheet(path: Path) -> list[list[str]]:
    """Return the cells that hold something, row by row; raises OSError where there is no file."""
    with ZipFile(path) as book:
        shared = []
        if "xl/sharedStrings.xml" in book.namelist():
            table = ElementTree.fromstring(book.read("xl/sharedStrings.xml"))
            shared = ["".join(t.text or "" for t in item.iter(f"{MAIN}t"))
                      for item in table.findall(f"{MAIN}si")]  # fmt: skip
        sheet = ElementTree.fromstring(book.read("xl/worksheets/sheet1.xml"))
    rows = []
    for row in sheet.iter(f"{MAIN}row"):
        cells = [(c.get("t"), c.findtext(f"{MAIN}v")) for c in row.findall(f"{MAIN}c")]
        rows.append([shared[int(v)] if kind == "s" else v for kind, v in cells if v is not None])
    return rows
