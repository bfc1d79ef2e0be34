"""What a program has said to be written outlives a power cut; without any one sync it would not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow.parquet
import pytest
from further import further
from recorded import SESSION, publish

from benchmarks.losing_disk import LosingDisk, Place
from gapbridge.bridge.calibration.session.journal import FILE, Journal, read_entries
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.document.output_file import write_table, write_text, write_together
from gapbridge.bridge.fleet.journal import Journal as FleetJournal
from gapbridge.bridge.fleet.output import parquet
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory, slices_of
from gapbridge.bridge.recording.finishing import finish, finish_recording
from gapbridge.bridge.recording.folder import number_after, segments
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.log.mcap_reading import last_batch, read_columns
from gapbridge.core.log.mcap_records import damages, is_whole
from gapbridge.core.log.mcap_schema import EVENTS
from gapbridge.drivers.clock import SYSTEM, Clock

N = 6
CELLS = "robot: ur10e\n" * 2000, "robot: ur5e\n"  # the first is longer than what is buffered
RUN = "run-20260101-000000"
Check = Callable[[Path], None]


class Scenario(Protocol):
    """What a program does on a disk; ``cut`` returns what is left at worst after a power cut now.

    ``expect`` is given what must hold of whatever any cut leaves, from now on.
    """

    def __call__(
        self, folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]
    ) -> None: ...


def session(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A calibration session, in a new folder; the second time behind a torn line."""
    path = folder / "session" / "one"

    def kept(least: int, most: int) -> Check:
        def check(left: Path) -> None:
            place = left / "session" / "one"
            numbers = []
            if (place / FILE).exists():
                numbers = [entry["number"] for entry in read_entries(place / FILE)]
            with Journal(place) as journal:  # as a session that is resumed
                assert [entry["number"] for entry in journal.entries] == numbers
                journal.add("reading", number=len(numbers))
            assert [e["number"] for e in read_entries(place / FILE)] == [*numbers, len(numbers)]
            assert numbers == list(range(len(numbers)))
            assert least <= len(numbers) <= most

        return check

    expect(kept(0, 0))
    with Journal(path) as journal:
        for k in range(3):
            expect(kept(k, k + 1))
            journal.add("reading", number=k)
            expect(kept(k + 1, k + 1))
            left = read_entries(cut() / "session" / "one" / FILE)
            assert [entry["number"] for entry in left] == list(range(k + 1))
    with (path / FILE).open("ab") as file:
        file.write(b'{"kind": "rea')
        file.flush()
        os.fsync(file.fileno())
    with Journal(path) as journal:
        assert journal.torn
        left_text = (cut() / "session" / "one" / FILE).read_bytes()
        assert left_text.endswith(b"\n")
        assert len(journal.entries) == len(left_text.splitlines()) == 3
        expect(kept(3, 4))
        journal.add("reading", number=3)
        expect(kept(4, 4))


def _reads(*texts: str | None) -> Check:
    """One of these is the text of the cell; None: there is no cell."""

    def check(left: Path) -> None:
        file = left / "cell.yaml"
        assert (file.read_text() if file.exists() else None) in texts

    return check


def cell(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A cell file, new and then written anew, as every text that the product writes."""
    path, before = folder / "cell.yaml", None
    for text in CELLS:
        expect(_reads(before, text))
        write_text(path, text)
        expect(_reads(text))
        assert (cut() / "cell.yaml").read_text() == text
        before = text


def tables(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A fleet's tables, each written anew."""
    kinds = {"arm": "string", "poses": "int64"}

    def rows(count: int) -> list[dict[str, Any]]:
        return [{"arm": f"arm-{k}", "poses": k} for k in range(count)]

    def read(left: Path) -> tuple[int, int]:
        parquet, csv = left / "sessions.parquet", left / "residuals.csv"
        found = 0
        if parquet.exists():
            found = len(pyarrow.parquet.read_table(parquet))
        return found, len(read_table(csv)) if csv.exists() else 0

    def among(*allowed: tuple[int, int]) -> Check:
        def check(left: Path) -> None:
            assert read(left) in allowed

        return check

    done = 0
    for count in (3000, 5):
        expect(among((done, done), (count, done)))
        write_together({folder / "sessions.parquet": parquet(kinds, rows(count))})
        expect(among((count, done), (count, count)))
        write_table(folder / "residuals.csv", ("a", "b"), np.ones((count, 2)))
        expect(among((count, count)))
        assert read(cut()) == (count, count)
        done = count


def read_table(path: Path) -> np.ndarray:
    lines = path.read_text().splitlines()
    assert path.read_text().endswith("\n")
    return np.array([[float(v) for v in line.split(",")] for line in lines[1:]])


def fleet(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A fleet's outcomes: at once, or when the run ends."""
    path = folder / "journal.jsonl"
    keys = ("one", "two", "three")

    def outcome(key: str) -> Outcome:
        return Outcome(key, "a", "s", "l", "c", DONE, 1.0)

    def known(left: Path) -> list[str]:
        with FleetJournal(left / "journal.jsonl", SYSTEM) as journal:
            return [key for key in keys if journal.known(key) is not None]

    def kept(least: int, most: int) -> Check:
        def check(left: Path) -> None:
            found = known(left)
            assert found == list(keys[: len(found)])
            assert least <= len(found) <= most
            with FleetJournal(left / "journal.jsonl", SYSTEM) as journal:  # a run that goes on
                journal.add(outcome("three"))
            assert known(left) == [*found, *(["three"] if "three" not in found else [])]

        return check

    expect(kept(0, 1))
    with FleetJournal(path, SYSTEM) as journal:
        journal.add(outcome("one"))
        expect(kept(1, 2))
        assert known(cut()) == ["one"]
        journal.add(outcome("two"))  # within a second: synced at the end
    expect(kept(2, 2))
    assert known(cut()) == ["one", "two"]
    with path.open("ab") as file:
        file.write(b'{"key": "thr')
    expect(kept(2, 3))
    with FleetJournal(path, SYSTEM) as journal:
        journal.add(outcome("three"))
    expect(kept(3, 3))


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


def _recorded(least: int, most: int) -> Check:
    """Whole flushes of ten cycles are left, ``least`` to ``most``, before and after finishing."""

    def check(left: Path) -> None:
        run, files = left / RUN, sorted(left.iterdir())
        for path in files:
            number_after(path)  # what a recorder that is started anew asks for
        if not files:
            assert not least
            return
        numbers = read_columns(run).get("number", np.zeros(0)).tolist()
        assert numbers == list(range(len(numbers)))
        assert len(numbers) % 10 == 0
        assert least <= len(numbers) <= most
        finished = finish_recording(run)
        assert read_columns(run).get("number", np.zeros(0)).tolist() == numbers
        assert not finish_recording(run)
        assert all(is_whole(path) and not damages(path) for path in finished)

    return check


def recording(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A recording of two files: what was flushed, and what was closed."""
    clock, flushed = _Later(), 0
    for part in (1, 2):
        path = folder / f"{RUN}-00{part}.mcap"
        expect(_recorded(flushed, flushed))
        segment = _segment(path, clock)
        for _ in range(2):
            clock.now += 1.0
            expect(_recorded(flushed, flushed + 10))
            segment.write(_rows(flushed, 10))
            segment.emit(EVENTS, {"kind": "note", "time": 1.0, "detail": "x"}, 1.0)
            segment.flush()
            flushed += 10
            expect(_recorded(flushed, flushed))
            assert _cycles(cut() / path.name) == flushed - 20 * (part - 1)
        segment.close()
        expect(_recorded(flushed, flushed))
        assert (cut() / path.name).read_bytes() == path.read_bytes()


def finished(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A recording that a kill has cut off in a chunk, and that is finished later."""
    path = folder / f"{RUN}-001.mcap"
    segment = _segment(path, _Later())
    segment.write(_rows(0, 10))
    segment.flush()
    assert _cycles(cut() / path.name) == 10
    segment._file.close()
    with path.open("ab") as file:
        file.write(path.read_bytes()[-2000:-1000])
    expect(_recorded(10, 10))
    assert finish(path)
    expect(_recorded(10, 10))
    assert (cut() / path.name).read_bytes() == path.read_bytes()


def abandoned(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A recording on a disk that takes no more: what was flushed stays, synced before or not."""
    path = folder / f"{RUN}-001.mcap"
    segment = _segment(path, _Later())
    for first in (0, 10):
        expect(_recorded(first, first + 10))
        segment.write(_rows(first, 10))
        segment.flush()
    expect(_recorded(10, 20))
    assert _cycles(cut() / path.name) == 10
    segment.write(_rows(20, 10))
    segment.abandon()
    expect(_recorded(20, 20))
    assert _cycles(cut() / path.name) == 20


def recorder(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
    """A run's recorder; the next run's finishes what was cut off."""
    clock, memory = _Later(), SharedMemory(N, clock=SYSTEM)
    settings = RecordingSettings(folder=folder / "recordings", keep_free=0.0)
    running = Recorder(settings, SESSION, memory, {}, lambda _: None, clock)

    def kept(*allowed: int) -> Check:
        def check(left: Path) -> None:
            place = left / "recordings"

            def numbers() -> list[float]:
                found = read_columns(place / SESSION) if segments(place, SESSION) else {}
                return list(found.get("number", ()))

            before = numbers()
            assert before == list(range(len(before)))
            assert len(before) in allowed
            settings = RecordingSettings(folder=place, keep_free=0.0)
            memory = SharedMemory(N, clock=SYSTEM)
            following = Recorder(
                settings, "run-20260102-000000", memory, {}, lambda _: None, SYSTEM
            )
            publish(memory, 5)
            for _ in range(3):
                following.step(flush=True)
            following.close()
            memory.close()
            assert numbers() == before
            assert len(read_columns(place / "run-20260102-000000")["number"]) == 5
            cut_off = [path for path in segments(place, SESSION) if not is_whole(path)]
            assert not any(last_batch(path) for path in cut_off)  # they hold nothing

        return check

    expect(kept(0))
    running.step()  # opens the file, and waits for the disk
    done = 0
    for count in (20, 10):
        publish(memory, count, seed=done)
        clock.now += 1.0
        expect(kept(done, done + count))
        running.step(flush=True)
        done += count
        expect(kept(done))
        assert _cycles(cut() / "recordings" / f"{SESSION}-001.mcap") == done
    running.close()
    expect(kept(done))
    left = cut() / "recordings" / f"{SESSION}-001.mcap"
    assert left.read_bytes() == (folder / "recordings" / left.name).read_bytes()
    memory.close()


SCENARIOS: dict[str, Scenario] = {
    "session": session, "cell": cell, "tables": tables, "fleet": fleet, "recording": recording,
    "finished": finished, "recorder": recorder, "abandoned": abandoned,
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
        scenario(folder, cut, found.expect)
    return found


def _fails(scenario: Scenario, base: Path, place: Place) -> bool:
    """Return whether a scenario fails without the syncs of one place."""
    try:
        play(scenario, base, dropped=place)
    except (AssertionError, OSError, ValueError, GapbridgeError):
        return True
    return False


@pytest.mark.parametrize("name", SCENARIOS)
def test_what_was_said_to_be_written_outlives_a_power_cut(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    found = play(scenario, tmp_path / "whole")
    assert found.places
    for k, place in enumerate(found.places):
        assert _fails(scenario, tmp_path / f"without{k}", place), f"{place}: could be left out"


@pytest.mark.parametrize("seed", [0, *further(*range(1, 10))])
@pytest.mark.parametrize("name", SCENARIOS)
def test_whatever_a_cut_at_any_point_leaves_is_read_as_before_or_as_after(
    tmp_path: Path, name: str, seed: int
) -> None:
    found = play(SCENARIOS[name], tmp_path, seed=seed)
    assert not found.failures, found.failures[0]
    assert found.drawn > 40


def in_place(path: Path, text: str) -> None:
    path.write_text(text)


def unsynced(path: Path, text: str) -> None:
    part = path.with_suffix(".part")
    part.write_text(text)
    os.replace(part, path)


@pytest.mark.parametrize("write", [in_place, unsynced])
def test_a_writer_that_a_cut_can_spoil_is_found(
    tmp_path: Path, write: Callable[[Path, str], None]
) -> None:
    def scenario(folder: Path, cut: Callable[[], Path], expect: Callable[[Check], None]) -> None:
        expect(_reads(None, CELLS[0]))
        write(folder / "cell.yaml", CELLS[0])
        expect(_reads(None, CELLS[0]))

    assert play(scenario, tmp_path, seed=0).failures


def test_a_new_file_has_its_name_on_disk_only_when_its_folder_is_synced(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    with LosingDisk(folder) as disk:
        (folder / "a").write_text("x")
        assert not list(disk.cut(tmp_path / "cut").iterdir())
