"""The settings of a link from its keys, as a cell file has them."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from gapbridge.bridge.cell.sections import LinkSettings


def link_settings(**keys: Any) -> LinkSettings:
    """Return them; raises pydantic's ValidationError."""
    adapter: TypeAdapter[LinkSettings] = TypeAdapter(LinkSettings)
    return adapter.validate_python(keys)
