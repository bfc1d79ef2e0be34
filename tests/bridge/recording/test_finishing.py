"""A recording that a kill has cut off gets its summary, by the next run or by export."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from recorded import SESSION, Desk, publish

from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.recording.export import export
from gapbridge.bridge.recording.finishing import finish, unfinished
from gapbridge.bridge.recording.folder import segments
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.core.log.mcap_records import all_records, chunk_offsets, is_whole
from gapbridge.drivers.clock import SYSTEM


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path / "recordings")


def cut_off(desk: Desk, behind: bytes = b"") -> Path:
    """Record some flushes and end as a kill does: without a summary, with whatever is behind."""
    recorder = desk.recorder()
    for _ in range(4):
        publish(desk.memory, 90)
        recorder.take({"kind": "note", "detail": "a word"})
        recorder.step(flush=True)
    path = recorder.path
    assert path is not None
    assert recorder._segment is not None
    recorder._segment.abandon()
    with path.open("ab") as file:
        file.write(behind)
    return path


def messages(path: Path, seeking: bool) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        if seeking:
            reader = SeekingReader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            found = list(reader.iter_messages(log_time_order=False))
            assert summary.statistics.message_count == len(found)
            assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        else:
            found = list(NonSeekingReader(file).iter_messages(log_time_order=False))
    return [(c.topic, m.log_time, m.data) for _, c, m in found]


def test_a_seeking_reader_opens_what_a_kill_has_left_and_finds_every_message(desk: Desk) -> None:
    path = cut_off(desk)
    before = read_columns(path)
    with pytest.raises(McapError), path.open("rb") as file:
        SeekingReader(file, validate_crcs=True).get_summary()
    assert unfinished(path.parent) == [path]
    assert finish(path)
    assert is_whole(path)
    assert unfinished(path.parent) == []
    found = messages(path, seeking=True)
    assert sorted(found) == sorted(messages(path, seeking=False))
    assert len([topic for topic, *_ in found if topic == "/state"]) == 360
    for name, values in read_columns(path).items():
        assert np.array_equal(values, before[name], equal_nan=True), name
    assert not finish(path)  # once is enough


def test_a_file_cut_at_any_byte_keeps_exactly_its_whole_chunks(desk: Desk) -> None:
    path = cut_off(desk)
    whole = path.read_bytes()
    with path.open("rb") as file:
        ends = [at + length for _, at, length in all_records(file, path)]
        file.seek(0)
        chunks = [at + length for at, length in chunk_offsets(file, path)]  # the first: words only
    random = np.random.default_rng(1)
    cuts = {*random.integers(ends[0], len(whole), 40).tolist(), *ends, *(e + 3 for e in chunks)}
    for cut in sorted(cuts):
        path.write_bytes(whole[:cut])
        assert finish(path), cut
        kept = sum(end <= cut for end in chunks)
        found = messages(path, seeking=True)
        assert sorted(found) == sorted(messages(path, seeking=False)), cut
        assert len([topic for topic, *_ in found if topic == "/state"]) == 90 * max(kept - 1, 0), (
            cut
        )


def test_garbage_behind_the_last_flush_goes(desk: Desk) -> None:
    path = cut_off(desk, bytes(np.random.default_rng(2).integers(0, 256, 5000, np.uint8)))
    assert finish(path)
    assert len(messages(path, seeking=True)) == len(messages(path, seeking=False))


def test_a_file_that_is_being_written_stays_as_it_is(desk: Desk) -> None:
    recorder = desk.recorder()
    publish(desk.memory, 90)
    recorder.step(flush=True)
    path = recorder.path
    assert path is not None
    before = path.read_bytes()
    assert not finish(path)
    assert path.read_bytes() == before
    recorder.close()


def test_the_next_run_finishes_what_the_last_one_left(desk: Desk) -> None:
    path = cut_off(desk)
    other = path.with_name("run-20200101-000000-001.mcap")
    path.rename(other)
    recorder = desk.recorder()
    for _ in range(3):
        publish(desk.memory, 30)
        recorder.step(flush=True)
    recorder.close()
    assert is_whole(other)
    assert any("finished" in str(event["detail"]) for event in desk.events)
    assert all(is_whole(one) for one in segments(other.parent, SESSION))


def test_export_finishes_what_it_finds_and_a_folder_that_is_closed_is_read_all_the_same(
    desk: Desk, tmp_path: Path
) -> None:
    path = cut_off(desk)
    assert export(path, tmp_path / "log.csv").rows == 360
    assert is_whole(path)


KILLED = """
import os, sys
from pathlib import Path
sys.path.insert(0, {here!r})
from recorded import Desk, publish
desk = Desk(Path({folder!r}))
recorder = desk.recorder()
publish(desk.memory, 120)
recorder.step(flush=True)
os.kill(os.getpid(), 9)
"""


def test_a_process_that_was_killed_holds_no_lock(tmp_path: Path) -> None:
    folder, here = tmp_path / "recordings", str(Path(__file__).parent)
    code = KILLED.format(here=here, folder=str(folder))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=False)
    (path,) = unfinished(folder)
    assert finish(path)
    assert len([1 for topic, *_ in messages(path, seeking=True) if topic == "/state"]) == 120


def test_a_file_with_nothing_but_its_head_is_finished_too(desk: Desk) -> None:
    path = desk.folder / "run-20200101-000000-001.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    segment = Segment(path, desk.memory.slices, [state.name for state in State], clock=SYSTEM)
    segment._file.flush()
    segment.abandon()
    assert finish(path)
    assert messages(path, seeking=True) == []


def test_a_damaged_chunk_costs_its_own_cycles_only(desk: Desk) -> None:
    """Cut there, the readable ones behind it would be lost for good."""
    path = cut_off(desk)
    whole = read_columns(path)["timestamp"]
    with path.open("rb") as file:
        chunks = list(chunk_offsets(file, path))
    offset, length = chunks[len(chunks) // 2]
    content = bytearray(path.read_bytes())
    content[offset + length // 2] ^= 0x40
    path.write_bytes(content)
    assert not finish(path)
    assert path.read_bytes() == content
    left = read_columns(path)["timestamp"]
    assert 0 < len(left) < len(whole)
    assert left[0] == whole[0]
    assert left[-1] == whole[-1]
    exported = export(path, path.with_suffix(".csv"))
    assert exported.rows == len(left)
    assert exported.gaps == len(whole) - len(left)
