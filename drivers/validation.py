"""Pydantic's validation errors of a user's file as what was found and what was expected."""

from __future__ import annotations

import difflib
import re
import typing
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from gapbridge.core.errors import Keys, key_path
from gapbridge.core.files import quoted

_OTHER_NOTATION = re.compile(r"[-+]?(0[0-9_]+|[0-9_]+(:[0-9.]+)+)")  # YAML 1.1: octal, base 60
_EXPECTED_TEXTS = {
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing_size": "a whole number of at most 18 digits",
    "finite_number": "a finite number",
    "string_type": "a text",
    "path_type": "a path",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "keys with values",
    "model_type": "keys with values",
    "model_attributes_type": "keys with values",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "less than {lt:g}",
    "less_than_equal": "{le:g} or less",
    "too_short": "{min_length} values",
    "too_long": "{max_length} values",
    "literal_error": "{expected}",
    "union_tag_not_found": "a key {discriminator}",
    "enum": "{expected}",
}


def validation_errors(schema: type[BaseModel], error: ValidationError) -> list[tuple[Keys, str]]:
    """Return the keys of each error and its text.

    Unknown keys come first: a misspelt key is also a missing one.
    """
    details = sorted(error.errors(), key=lambda d: d["type"] != "extra_forbidden")
    return [_validation_error(schema, detail) for detail in details if not _is_echo(detail)]


def _is_echo(detail: ErrorDetails) -> bool:
    """Return whether a length is reported only because wrong entries were not counted."""
    if detail["type"] not in ("too_short", "too_long"):
        return False
    return bool(detail["ctx"]["actual_length"] != len(detail["input"]))


def _validation_error(schema: type[BaseModel], detail: ErrorDetails) -> tuple[Keys, str]:
    if detail["type"] == "invalid_key":
        keys, _ = _file_keys(schema, detail["loc"][:-1], False)
        return [*keys, str(detail["input"])], f"found a key {detail['input']!r}, expected a word"
    unknown = detail["type"] == "extra_forbidden"
    keys, model = _file_keys(schema, detail["loc"], unknown)
    if detail["type"] == "union_tag_invalid":
        keys.append(_discriminator_key(str(detail["ctx"].get("discriminator", ""))))
        found, expected = repr(detail["ctx"]["tag"]), f"one of {detail['ctx']['expected_tags']}"
    elif unknown:
        found, expected = _unknown_key(keys, model)
    else:
        found, expected = _found_text(detail), _expected_text(detail, _description(schema, keys))
    return keys, f"found {found}, expected {expected}"


def _discriminator_key(reported: str) -> str:
    """Return the key that selects a union member; pydantic quotes it, or names a function."""
    key = reported.strip("'")
    return key if key.isidentifier() else "driver"


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return a hint that names the most similar known name; all of them if it is unlike it."""
    names = list(known)
    near = difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    nearest = difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.0)
    listed = f"known here: {', '.join(names)}"
    return f"nearest {nearest[0]!r}; {listed}" if nearest else listed


def _unknown_key(keys: Keys, model: type[BaseModel] | None) -> tuple[str, str]:
    """Return what was found, and what was expected."""
    known = list(model.model_fields) if model else []
    *parents, key = keys
    inside = f" in {key_path(parents)}" if parents else ""
    return (
        f"an unknown key {str(key)!r}{inside}", f"one that is known; {suggestion(str(key), known)}"
    )  # fmt: skip


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return the pydantic models inside an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for part in typing.get_args(annotation) for m in _models(part)]


def _file_keys(
    schema: type[BaseModel], loc: tuple[str | int, ...], unknown: bool
) -> tuple[list[str | int], type[BaseModel] | None]:
    """Return the keys of the file in pydantic's location, and the model of the last one.

    Pydantic puts the names of union members and validators between the keys. ``unknown``: the last
    one is a key that no model has.
    """
    keys: list[str | int] = []
    models, holder = [schema], None
    names_entry = False  # whether the next part is a key of a dictionary
    for part in loc:
        if isinstance(part, int) or names_entry:
            keys.append(str(part) if names_entry else part)
            names_entry = False
            continue
        if len(models) > 1 and (chosen := [m for m in models if _tag(m) == part]):
            models = chosen  # before keys: a kind of instrument is called ``file`` as its key is
            continue
        owner = next((m for m in models if part in m.model_fields), None)
        if owner is not None:
            holder = owner
            keys.append(part)
            models = _models(owner.model_fields[part].annotation)
            names_entry = typing.get_origin(owner.model_fields[part].annotation) is dict
        elif part == loc[-1] and models and (unknown or not _is_union_label(part, models)):
            chosen = [m for m in models if m.__name__ in loc] or models
            return [*keys, part], chosen[0]
    return keys, holder


def _tag(model: type[BaseModel]) -> str | None:
    """Return the driver, mode or kind that a model is of; None: it is no member of a union."""
    for name in ("driver", "mode", "kind"):
        field = model.model_fields.get(name)
        values = () if field is None else typing.get_args(field.annotation)
        if len(values) == 1:
            return str(values[0])
    return None


def _is_union_label(part: str, models: list[type[BaseModel]]) -> bool:
    names = {m.__name__ for m in models}
    return part in names or part in ("str", "float", "int", "bool", "path") or "[" in part


def _description(schema: type[BaseModel], keys: Keys) -> str:
    models, text = [schema], ""
    for key in keys:
        if isinstance(key, str):
            owner = next((m for m in models if key in m.model_fields), None)
            if owner is None:
                return text
            field = owner.model_fields[key]
            text, models = field.description or "", _models(field.annotation)
    return text


def _found_text(error: ErrorDetails) -> str:
    if error["type"] == "missing":
        return "nothing"
    value = error["input"]
    if error["type"] in ("too_short", "too_long"):
        return f"{len(value)} values"
    if value is None:
        return "nothing"
    return quoted(value)


def _expected_text(error: ErrorDetails, description: str) -> str:
    if error["type"] == "missing":
        return description or "it here"
    if error["type"] in ("value_error", "assertion_error"):
        return str(error.get("ctx", {}).get("error", error["msg"])).removeprefix("expected ")
    template = _EXPECTED_TEXTS.get(error["type"])
    if template is None:
        return str(error["msg"]).removeprefix("Input should be ")
    text = template.format(**error.get("ctx", {}))
    if error["type"] in ("float_type", "int_type") and isinstance(error["input"], str):
        text += " without leading zeros or colons" * bool(_OTHER_NOTATION.fullmatch(error["input"]))
    return f"{text} ({description})" if description else text
