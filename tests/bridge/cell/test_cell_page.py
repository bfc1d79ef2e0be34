"""docs/cell.md, the reference of all keys, against the schema: names, defaults and bounds."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from gapbridge.bridge.cell.schema import CellFile

PAGE = (Path(__file__).parents[3] / "docs" / "cell.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"0x[0-9A-Fa-f]+|\d+(?:\.\d+)?(?:e-?\d+)?")
ROWS = {
    name: [line for line in part.splitlines() if line.startswith("| `")]
    for title, part in re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
    for name in re.findall(r"\w+", title)
}
ROWS["ft_sensor"] += ROWS["link"]  # those of a CAN link, as the page says


def models(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield every model that an annotation allows."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models(part)


def fields(annotation: object) -> Iterator[tuple[type[BaseModel], str, FieldInfo]]:
    """Yield every key of the models that an annotation allows, and of those inside them."""
    for model in models(annotation):
        for name, field in model.model_fields.items():
            yield model, name, field
            yield from fields(field.annotation)


def missing(name: str, field: FieldInfo, rows: list[str]) -> Iterator[object]:
    """Yield what the rows of a key do not have: itself, its default, its largest value."""
    key = re.compile(rf"[`.]{name}(\[\])?[`.\[]")
    text = " ".join(row for row in rows if key.search(row.split(" | ")[0]))
    if not text:
        yield name
    numbers = {float(int(n, 0) if n.startswith("0x") else n) for n in NUMBER.findall(text)}
    for value in [field.default, *(bound.le for bound in field.metadata if hasattr(bound, "le"))]:
        if isinstance(value, bool | str):
            found = str(value).lower() in text.lower()
        else:
            found = not isinstance(value, int | float) or float(value) in numbers
        if not found:
            yield name, value


def test_every_key_is_on_the_page_with_its_default_and_largest_value() -> None:
    keys = {
        (model, name): (section, field)
        for section, whole in reversed(CellFile.model_fields.items())
        for model, name, field in fields(whole.annotation)
        if section != "provenance"
    }
    assert len(keys) > 150
    assert [
        (section, found)
        for (_, name), (section, field) in keys.items()
        for found in missing(name, field, ROWS[section])
    ] == []
