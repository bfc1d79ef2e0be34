"""What the page shows, without a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import Configuration, read_configuration
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


CELL = """robot: {model: ur10e}
link: {driver: ur_rtde, host: 192.0.2.7}
web: {}
payload: {mass: 2.0, cog: [0, 0, 0.06]}
"""
SEVEN = ", ".join(
    f"{{a: 0.3, alpha: {k % 2}, d: 0.1, offset: 0, mass: 2.0, cog: [0, 0, 0]}}" for k in range(7)
)


def extra_of(configuration: Configuration) -> dict[str, Any]:
    return {"text": configuration.text, "digests": configuration.digests}


def test_an_arm_is_predicted_with_the_cell_in_use_and_not_with_an_edited_one(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    cell, memory = tmp_path / "cell.yaml", SharedMemory(6, clock=SYSTEM)
    request.addfinalizer(memory.close)
    row = np.full(memory.width, np.nan)
    row[memory.slices["actual_q"]] = (0.1, -1.2, 1.4, -1.7, -1.5, 0.3)

    def begun(used: Configuration, extra: dict[str, Any]) -> PageData:
        return PageData(used.settings, 6, "run", memory, SYSTEM, extra)

    def mass(page: PageData) -> float | None:
        page._prediction.reading.join()
        found = page._prediction.arm(row)
        return None if found is None else float(found["mass"])

    cell.write_text(CELL)
    used = read_configuration(cell)
    page = begun(used, extra_of(used))
    assert mass(page) == 2.0
    cell.write_text(CELL.replace("2.0", "10.0"))
    assert mass(page) == 2.0
    again = begun(used, extra_of(used))
    assert mass(again) is None
    new = read_configuration(cell)
    for shown in (page, again):
        told = shown.update([{"kind": "cell", **extra_of(new)}])
        assert mass(shown) == 10.0
        assert "mass:" not in str(told)
        assert not shown.events
    cell.write_text(f"robot: {{dh: [{SEVEN}]}}\n")
    other = begun(used, {})
    assert mass(other) is None
    assert other._prediction._model is not None
