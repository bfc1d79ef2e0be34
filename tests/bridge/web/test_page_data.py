"""What the page shows, without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.web.page_data import PageData
from gapbridge.drivers.clock import SYSTEM


def test_a_page_begun_while_no_loop_runs_does_not_show_the_last_ones_state(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    settings = DaemonSettings.model_validate(
        {"cell": tmp_path / "none.yaml", "link": {"driver": "ur_rtde", "host": "127.0.0.2"},
         "web": {}}
    )  # fmt: skip
    memory = SharedMemory(6, clock=SYSTEM)
    request.addfinalizer(memory.close)
    memory.note_state(State.COMPENSATING)
    page = PageData(settings, 6, "run", memory, SYSTEM)
    for event, shown in (
        ({"kind": "status", "state": "disconnected"}, "disconnected"),
        ({"kind": "transition", "to": "COMPENSATING", "time": 1.0}, "compensating"),
        ({"kind": "status", "state": "compensating"}, "compensating"),
    ):
        page.update([event])
        assert page.now()["state"] == shown
