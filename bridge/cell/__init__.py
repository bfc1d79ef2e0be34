"""Cell files: read them with ``load_cell``, write them with ``save_cell``."""

from gapbridge.bridge.cell.cell import Cell, load_cell
from gapbridge.bridge.cell.saving import save_cell

__all__ = ["Cell", "load_cell", "save_cell"]
