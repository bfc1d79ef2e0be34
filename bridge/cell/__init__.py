"""Cell files: read them with ``load_cell``, write them with ``save_cell``.

The names are imported when they are asked for: who asks a running daemon reads no cell.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gapbridge.bridge.cell.cell import Cell, load_cell
    from gapbridge.bridge.cell.saving import save_cell

__all__ = ["Cell", "load_cell", "save_cell"]
PLACES = {"Cell": "cell", "load_cell": "cell", "save_cell": "saving"}


def __getattr__(name: str) -> Any:
    """Return a public name, imported now."""
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{PLACES[name]}"), name)
