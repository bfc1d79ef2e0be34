"""What a session can be for; an explicit table of jobs."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from gapbridge.bridge.calibration.jobs.job import Job
    from gapbridge.bridge.calibration.options import SessionOptions
    from gapbridge.bridge.calibration.session.prompt import Prompt
    from gapbridge.bridge.calibration.session.session import Session
    from gapbridge.bridge.cell import Cell

JOBS: dict[str, str] = {
    "whole": "gapbridge.bridge.calibration.jobs.calibrate:WholeJob",
    "verify": "gapbridge.bridge.calibration.jobs.verify:VerifyJob",
    "payload": "gapbridge.bridge.calibration.jobs.payload:PayloadJob",
    "tool": "gapbridge.bridge.calibration.jobs.tool:ToolJob",
}
"""SessionOptions.kind -> ``module:Class``, imported on use."""


def make_job(cell: Cell, options: SessionOptions, prompt: Prompt, session: Session) -> Job:
    """Return the job that was ordered. Raises InputError where the cell does not allow it."""
    module, kind = JOBS[options.kind].split(":")
    found = getattr(importlib.import_module(module), kind)
    return cast("Job", found(cell, options, prompt, session))
