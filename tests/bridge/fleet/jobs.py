"""Jobs for real worker processes; the name of the log determines what they do."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell import Cell
from gapbridge.core.log.log import Log


def count_rows(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rows of the log and the process, after ``others`` processes have started."""
    time.sleep(options.get("pause", 0.0))
    if "present" in options:
        present = Path(str(options["present"]))
        (present / str(os.getpid())).touch()
        until = time.monotonic() + 60.0
        while len(list(present.iterdir())) < options["others"] and time.monotonic() < until:
            time.sleep(0.01)
    return {"rows": len(log), "process": os.getpid()}


def kill_itself(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Kill the process for logs named ``killer``; for those named ``once`` at the first run."""
    _record_run(log, options)
    name = Path(log.path).stem
    if "killer" in name or ("once" in name and _runs(log, options) == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return count_rows(cell, log, options)


def fail(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Raise an unexpected error for logs named ``odd``."""
    if "odd" in Path(log.path).stem:
        raise ZeroDivisionError("the odd one")
    return count_rows(cell, log, options)


def _record_run(log: Log, options: Mapping[str, Any]) -> None:
    with _run_record(options).open("a") as file:
        file.write(f"{Path(log.path).stem}\n")


def _runs(log: Log, options: Mapping[str, Any]) -> int:
    return _run_record(options).read_text().split().count(Path(log.path).stem)


def _run_record(options: Mapping[str, Any]) -> Path:
    return Path(str(options["book"]))
