"""What a session can be for; an explicit table of jobs."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from bridge.calibration.book import Book
    from bridge.calibration.job import Job
    from bridge.calibration.order import Order
    from bridge.calibration.talk import Talk
    from bridge.cell import Cell

JOBS: dict[str, str] = {
    "whole": "bridge.calibration.whole_job:WholeJob",
    "verify": "bridge.calibration.verify_job:VerifyJob",
    "payload": "bridge.calibration.payload_job:PayloadJob",
    "tool": "bridge.calibration.tool_job:ToolJob",
}
"""Order.kind -> ``module:Class``, imported on use."""


def make_job(cell: Cell, order: Order, talk: Talk, book: Book) -> Job:
    """Return the job that was ordered. Raises InputError where the cell does not allow it."""
    module, kind = JOBS[order.kind].split(":")
    found = getattr(importlib.import_module(module), kind)
    return cast("Job", found(cell, order, talk, book))
