"""The base class of mappings in users' files: a cell's sections, a driver's profile."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError
from pydantic_core.core_schema import no_info_before_validator_function as before

from gapbridge.drivers.addresses import host_name, plain_host

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
Host = Annotated[str, AfterValidator(host_name)]
PlainHost = Annotated[
    str, AfterValidator(plain_host)
]  # an IPv4 address or a name: no port, no IPv6


class Section(BaseModel):
    """One mapping: unknown keys are refused, and instances are immutable.

    A number or a boolean is taken as it stands only: pydantic alone would read ``true`` as 1.0 and
    the text ``'on'`` as true. Whole floats are whole numbers (``1e6``); paths and lists remain
    pydantic's.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's schema, its numbers and booleans taken literally."""
        schema: CoreSchema = _literal(handler(source), cls)
        return schema

    def located(self, folder: Path) -> Self:
        """Return it with all paths in it, which are relative to ``folder``, made absolute."""
        placed: dict[str, object] = {}
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, Path):
                placed[name] = folder / value
            elif isinstance(value, Section):
                placed[name] = value.located(folder)
        return self.model_copy(update=placed)

    def paths(self) -> Iterator[tuple[tuple[str | int, ...], Path]]:
        """Yield the keys of each path that the file states, and the path as it is in the file."""
        for name in type(self).model_fields:
            if name in self.model_fields_set:
                yield from _paths((name,), getattr(self, name))


def _literal(part: Any, section: type[Section]) -> Any:
    """Return a part of a section's core schema with its numbers and booleans taken literally."""
    if isinstance(part, list | tuple):
        return type(part)(_literal(item, section) for item in part)
    if not isinstance(part, dict) or part.get("cls", section) is not section:
        return part  # another section's schema is literal already
    kind = part.get("type")
    if kind in ("float", "bool"):
        return {"strict": True, **part}
    if kind == "int":
        return part if part.get("strict") else before(_refuse_bool_and_text, part)
    return {
        key: value if key in ("default", "metadata") else _literal(value, section)
        for key, value in part.items()
    }


def _refuse_bool_and_text(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise PydanticKnownError("int_type")
    return value


def _paths(
    keys: tuple[str | int, ...], value: object
) -> Iterator[tuple[tuple[str | int, ...], Path]]:
    """Yield the paths in the value at ``keys``; see Section.paths."""
    if isinstance(value, Path):
        yield keys, value
    elif isinstance(value, Section):
        yield from (((*keys, *inner), path) for inner, path in value.paths())
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _paths((*keys, index), item)
