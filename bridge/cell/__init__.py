"""Cell files: read them with ``load_cell``, write them with ``save_cell``.

The names are imported on first use: a client of a running daemon does not read a cell.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gapbridge.bridge.cell.cell import Cell, load_cell
    from gapbridge.bridge.cell.saving import save_cell

__all__ = ["Cell", "load_cell", "save_cell"]
MODULES = {"Cell": "cell", "load_cell": "cell", "save_cell": "saving"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{MODULES[name]}"), name)
