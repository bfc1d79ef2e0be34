"""Strict JSON: NaN and infinite numbers are written as null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def json_text(document: Mapping[str, Any], separators: tuple[str, str] | None = None) -> str:
    """Return a document as JSON; values of other types are written as text."""
    try:
        return json.dumps(document, default=str, allow_nan=False, separators=separators)
    except ValueError:
        return json.dumps(finite(document), default=str, separators=separators)


def finite(value: Any) -> Any:
    """Return a value as JSON has it: NaN and infinity as None, arrays and tuples as lists."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":  # no call for each number
        plain = value.astype(object)
        plain[~np.isfinite(value)] = None
        return plain.tolist()
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
