"""A fleet of small logs for tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gapbridge.bridge.fleet.cell_source import OneCell
from gapbridge.bridge.fleet.runner import make_tasks
from gapbridge.bridge.fleet.session import find_sessions
from gapbridge.bridge.fleet.task import SessionJob, Task
from tests.bridge.cli_runs import (
    bent_model,
    cell_in,
    columns_of,
    log_in,
    measured,
    poses_and_loads,
)


def logs_in(folder: Path, names: Sequence[str], rows: int = 12) -> Path:
    """Write one log a name (``arm/session``) and return the folder."""
    logs = folder / "logs"
    for seed, name in enumerate(names):
        place = logs / name
        place.parent.mkdir(parents=True, exist_ok=True)
        q, loads = poses_and_loads(rows, seed)
        columns = columns_of(q, loads) | measured(bent_model(), q, loads, noise=1e-5)
        log_in(place.parent, columns, f"{place.name}.csv")
    return logs


def tasks_in(
    folder: Path, names: Sequence[str], work: SessionJob, options: Mapping[str, Any] | None = None
) -> list[Task]:
    """Return the tasks of small logs under one cell."""
    found = find_sessions([str(logs_in(folder, names))])
    tasks, bad = make_tasks(found.sessions, OneCell(cell_in(folder)), work, options or {})
    assert not bad
    return tasks
