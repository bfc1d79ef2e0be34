"""What side processes are told of a changed cell: those that run, and those that start later."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.daemon import side_processes
from gapbridge.bridge.daemon.side_processes import SideProcesses
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.recording import main as recording
from gapbridge.drivers.clock import SYSTEM, Clock

CELL = """robot: {model: ur10e}
link: {driver: ur_rtde, host: 192.0.2.7}
recording: {folder: recordings}
payload: {mass: 5.0}
"""


class Side:
    """A side process that is told and not run."""

    def __init__(self, module: str, start_data: dict[str, Any], *_: Any) -> None:
        self.start_data, self.told = start_data, list[dict[str, Any]]()

    def emit(self, event: dict[str, Any]) -> None:
        self.told.append(event)


def test_a_side_process_gets_the_cell_in_use_also_if_it_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(side_processes, "SideProcess", Side)
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    first, sides = read_configuration(cell), SideProcesses(SYSTEM)
    sides.start(first, "run-1", cast(SharedMemory, None), subprocess.DEVNULL)
    side = cast(Side, sides._running["recorder"])
    sides.configure(first)  # a loop that was started again
    assert side.told == []
    cell.write_text(CELL.replace("5.0", "7.0"))
    second = read_configuration(cell)
    cell.write_text(CELL.replace("5.0", "9.0"))  # edited since
    sides.configure(second)
    (event,) = side.told
    assert (event["kind"], event["text"]) == ("cell", second.text)
    assert side.start_data["extra"] == {"text": second.text, "digests": second.digests}
    assert side.start_data["settings"] == second.settings.model_dump(mode="json")
    assert side.start_data["session"] == "run-1"


class Events:
    """The daemon's events, up to its end."""

    closed = False

    def __init__(self, *events: dict[str, Any]) -> None:
        self._events = events

    def wait(self, _: float) -> None:
        pass

    def poll(self) -> tuple[dict[str, Any], ...]:
        self.closed = True
        return self._events


def test_a_recording_has_the_cells_that_were_in_use_and_no_other(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    used = read_configuration(cell)
    taken = CELL.replace("5.0", "7.0") + "web: {token: squeamish}\n"
    cell.write_text(CELL.replace("5.0", "heavy"))  # refused
    refused = {"kind": "configuration", "ok": False, "hash": used.hash, "detail": "not taken"}
    read = {"kind": "configuration", "ok": True, "hash": "a hash", "detail": "is being taken"}
    events = Events(refused, read, {"kind": "cell", "text": taken, "digests": {}})
    clock = Clock()
    clock.sleep = lambda _: None
    written, changed = list[dict[str, Any]](), list[dict[str, Any]]()
    recorder = SimpleNamespace(
        take=written.append, change_configuration=changed.append, step=lambda: 0
    )
    start = SimpleNamespace(events=events, clock=clock, settings=used.settings, n=6)
    recording._follow(cast(Any, start), cast(Any, recorder))
    assert written == [refused, read]
    (document,) = changed
    assert "mass: 7.0" in document["text"]
    assert "squeamish" not in document["text"]
    assert document == recording.configuration_of(cast(Any, start), taken)
    assert recording.configuration_of(cast(Any, start), used.text)["sha256"] == used.hash
