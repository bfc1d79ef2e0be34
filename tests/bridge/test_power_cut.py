"""What a program has said to be written outlives a power cut; without any one sync it would not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from power_cut import LosingDisk, Place

from gapbridge.bridge.calibration.session.journal import FILE, Journal, read_entries
from gapbridge.bridge.cell.saving import write_text
from gapbridge.bridge.fleet.journal import Journal as FleetJournal
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.bridge.recording import finishing
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.core.log.mcap_schema import EVENTS
from gapbridge.drivers.clock import SYSTEM, Clock

Scenario = Callable[[Path, Callable[[], Path]], None]
N = 6


def session(folder: Path, cut: Callable[[], Path]) -> None:
    """A calibration session, in a new folder; the second time behind a torn line."""
    path = folder / "session" / "one"
    with Journal(path) as journal:
        for k in range(3):
            journal.add("reading", number=k)
            left = read_entries(cut() / "session" / "one" / FILE)
            assert [entry["number"] for entry in left] == list(range(k + 1))
    with (path / FILE).open("ab") as file:
        file.write(b'{"kind": "rea')
        file.flush()
        os.fsync(file.fileno())
    with Journal(path) as journal:
        assert journal.torn
        left = (cut() / "session" / "one" / FILE).read_bytes()
        assert left.endswith(b"\n")
        assert len(journal.entries) == len(left.splitlines()) == 3


def cell(folder: Path, cut: Callable[[], Path]) -> None:
    """A cell file, new and then written anew; a token file is written the same way."""
    path = folder / "cell.yaml"
    for text in ("robot: ur10e\n", "robot: ur5e\n"):
        write_text(path, text)
        assert (cut() / "cell.yaml").read_text() == text


def fleet(folder: Path, cut: Callable[[], Path]) -> None:
    """A fleet's outcomes: at once, or when the run ends."""
    path = folder / "journal.jsonl"

    def outcome(key: str) -> Outcome:
        return Outcome(key, "a", "s", "l", "c", DONE, 1.0)

    def left() -> list[str]:
        with FleetJournal(cut() / "journal.jsonl", SYSTEM) as journal:
            return [key for key in ("one", "two") if journal.known(key) is not None]

    with FleetJournal(path, SYSTEM) as journal:
        journal.add(outcome("one"))
        assert left() == ["one"]
        journal.add(outcome("two"))  # within a second: synced at the end
    assert left() == ["one", "two"]


class _Later(Clock):
    """A clock that goes on when it is set to."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 1000.0
        self.monotonic = lambda: self.now


def _cycles(of: Path) -> int:
    return len(read_columns(of).get("timestamp", ()))


def _segment(path: Path, clock: Clock) -> Segment:
    return Segment(path, slices_of(N), [state.name for state in State], clock)


def _rows(first: int, count: int) -> np.ndarray:
    slices = slices_of(N)
    rows = np.zeros((count, max(part.stop for part in slices.values())))
    rows[:, slices["number"].start] = range(first, first + count)
    rows[:, slices["timestamp"].start] = 0.002 * np.arange(first, first + count)
    rows[:, slices["received"].start] = 1.0 + 0.002 * np.arange(first, first + count)
    return rows


def recording(folder: Path, cut: Callable[[], Path]) -> None:
    """A recording: what was flushed, what was closed, and what is finished after a kill."""
    name = "run-20260101-000000-000.mcap"
    path = folder / name
    clock = _Later()
    segment = _segment(path, clock)
    for k in range(2):
        clock.now += 1.0
        segment.write(_rows(10 * k, 10))
        segment.emit(EVENTS, {"kind": "note", "time": 1.0, "detail": "x"}, 1.0)
        segment.flush()
        assert _cycles(cut() / name) == 10 * (k + 1)
    segment.close()
    assert (cut() / name).read_bytes() == path.read_bytes()


def finished(folder: Path, cut: Callable[[], Path]) -> None:
    """A recording that a kill has cut off, and that is finished later."""
    path = folder / "run-20260101-000000-000.mcap"
    segment = _segment(path, _Later())
    segment.write(_rows(0, 10))
    segment.flush()
    assert _cycles(cut() / path.name) == 10
    segment._file.close()
    assert finishing.finish(path)
    assert (cut() / path.name).read_bytes() == path.read_bytes()


SCENARIOS: dict[str, Scenario] = {
    "session": session, "cell": cell, "fleet": fleet, "recording": recording, "finished": finished,
}  # fmt: skip


def play(scenario: Scenario, base: Path, **disk: Any) -> LosingDisk:
    """Play a scenario on a disk that loses what was not synced."""
    folder = base / "disk"
    folder.mkdir(parents=True)
    count = [0]

    def cut() -> Path:
        count[0] += 1
        return found.cut(base / f"cut{count[0]}")

    with LosingDisk(folder, **disk) as found:
        scenario(folder, cut)
    return found


def _fails(scenario: Scenario, base: Path, place: Place) -> bool:
    """Return whether a scenario fails without the syncs of one place."""
    try:
        play(scenario, base, dropped=place)
    except (AssertionError, OSError, GapbridgeError):
        return True
    return False


@pytest.mark.parametrize("name", SCENARIOS)
def test_what_was_said_to_be_written_outlives_a_power_cut(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    found = play(scenario, tmp_path / "whole")
    assert found.places
    for k, place in enumerate(found.places):
        assert _fails(scenario, tmp_path / f"without{k}", place), f"{place}: could be left out"


def test_a_new_file_has_its_name_on_disk_only_when_its_folder_is_synced(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    with LosingDisk(folder) as disk:
        (folder / "a").write_text("x")
        assert not list(disk.cut(tmp_path / "cut").iterdir())
