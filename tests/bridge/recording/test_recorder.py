"""Recording: what goes in comes out bit for bit, wherever a file ends."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator, validate
from mcap.reader import NonSeekingReader, SeekingReader
from recorded import SESSION, Array, Desk, publish, same_bits
from recorded_documents import read_documents

from gapbridge.bridge.recording.folder import new_session, segments
from gapbridge.core.errors import LogError
from gapbridge.core.log.mcap_reading import (
    files_of,
    last_batch,
    read_batches,
    read_columns,
    read_configuration,
)
from gapbridge.core.log.mcap_records import chunk_offsets, is_whole

EVENTS: list[dict[str, object]] = [
    {"kind": "transition", "from": "OBSERVING", "to": "FAULT", "cause": "silence", "detail": "-"},
    {"kind": "status", "state": "fault", "since": 3.0, "why": ""},
    {"kind": "note", "detail": "a word"},
]


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path / "recordings")


def numbers(path: Path) -> list[int]:
    columns = read_columns(path)
    return [int(k) for k in columns.get("number", [])]


def test_every_number_of_every_cycle_comes_back_bit_for_bit(desk: Desk) -> None:
    rows = desk.record(300, 1, 250)
    columns = read_columns(desk.stem)
    assert set(columns) == set(desk.memory.slices)
    for name, part in desk.memory.slices.items():
        found = columns[name].reshape(len(rows), -1)
        assert same_bits(found, np.ascontiguousarray(rows[:, part])), name


def test_mcaps_own_readers_and_protobufs_own_decoder_read_the_same(desk: Desk) -> None:
    desk.recorder().close()
    recorder = desk.recorder()
    rows = publish(desk.memory, 120)
    for event in EVENTS:
        recorder.take({"time": 5.0, "monotonic": 1.0, "sequence": 1, **event})
    recorder.close()
    path = desk.files[-1]
    for reader in (SeekingReader, NonSeekingReader):
        with path.open("rb") as file:
            seen: dict[str, list[object]] = {}
            for schema, channel, message in reader(file, validate_crcs=True).iter_messages():
                assert schema is not None
                if channel.message_encoding == "protobuf":
                    pool = descriptor_pool.DescriptorPool()
                    for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                        pool.Add(one)
                    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                    assert schema.encoding == "protobuf"
                    seen.setdefault(channel.topic, []).append(kind.FromString(message.data))
                else:
                    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                    rules = json.loads(schema.data)
                    assert rules["type"] == "object"
                    Draft202012Validator.check_schema(rules)
                    validate(json.loads(message.data), rules)
        assert {topic: len(found) for topic, found in seen.items()} == {
            "/state": 120, "/setpoint": 120, "/loop": 120,
        }  # fmt: skip
        part = desk.memory.slices
        state, setpoint, loop = (seen[topic][7] for topic in ("/state", "/setpoint", "/loop"))
        assert list(state.actual_q) == list(rows[7, part["actual_q"]])  # type: ignore[attr-defined]
        assert state.timestamp == rows[7, 1]  # type: ignore[attr-defined]
        assert list(setpoint.offset) == list(rows[7, part["offset"]])  # type: ignore[attr-defined]
        names = loop.DESCRIPTOR.fields_by_name["state"].enum_type.values_by_number  # type: ignore[attr-defined]
        assert names[loop.state].name == "OBSERVING"  # type: ignore[attr-defined]


def test_messages_stand_at_the_calendars_time_in_order(desk: Desk) -> None:
    desk.record(50)
    (batch,) = (batch for batch in read_batches(desk.stem) if len(batch))
    assert np.diff(batch.log_time) == pytest.approx(2e6, abs=2)
    clock = read_configuration(desk.stem)["clock"]
    assert batch.log_time[0] / 1e9 == pytest.approx(clock + 1000.0)


def test_events_and_configuration_stand_beside_the_cycles(desk: Desk) -> None:
    recorder = desk.recorder()
    recorder.step()
    recorder.take({"time": 5.0, "kind": "transition", "from": "OBSERVING", "to": "FAULT",
                   "cause": "silence", "detail": "no state"})  # fmt: skip
    recorder.take({"time": 6.0, "kind": "status", "state": "fault", "age": float("nan")})
    recorder.close()
    (event,) = read_documents(desk.stem)
    assert (event["to"], event["cause"]) == ("FAULT", "silence")
    assert read_documents(desk.stem, "/status")[0]["age"] is None
    assert read_configuration(desk.stem)["session"] == SESSION
    with desk.files[0].open("rb") as file:
        (log,) = (m for s, c, m in SeekingReader(file).iter_messages(["/log"]))
    entry = json.loads(log.data)
    assert entry["level"] == 4
    assert entry["message"] == "OBSERVING -> FAULT (silence): no state"
    assert entry["timestamp"] == {"sec": 5, "nsec": 0}


def test_what_was_flushed_is_there_before_the_file_is_closed(desk: Desk) -> None:
    recorder = desk.recorder()
    publish(desk.memory, 40)
    recorder.step(flush=True)
    assert not is_whole(desk.files[0])
    assert numbers(desk.stem) == list(range(40))
    recorder.close()
    assert is_whole(desk.files[0])


def test_a_file_cut_at_any_byte_of_its_last_chunk_reads_up_to_the_one_before(desk: Desk) -> None:
    desk.record(30, 2)
    (path,) = desk.files
    data = path.read_bytes()
    with path.open("rb") as file:
        *_, (start, length) = chunk_offsets(file, path)
    cut = desk.folder / "cut.mcap"
    for end in range(start - 9, start + length):
        cut.write_bytes(data[:end])
        assert numbers(cut) == list(range(30)), end
    cut.write_bytes(data[: start + length])
    assert numbers(cut) == list(range(32))


@pytest.fixture(scope="module")
def three_chunks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Desk, Array]:
    desk = Desk(tmp_path_factory.mktemp("chunks"))
    return desk, desk.record(20, 20, 20)


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Return where chunks begin and end."""
    with path.open("rb") as file:
        return [(at, at + length) for at, length in chunk_offsets(file, path)]


@settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
@given(share=st.floats(0, 1), tail=st.binary(max_size=200) | st.just(bytes(4096)))
def test_whatever_stands_behind_or_instead_of_the_end_nothing_before_is_harmed(
    three_chunks: tuple[Desk, Array], share: float, tail: bytes
) -> None:
    path = three_chunks[0].files[0]
    whole = path.read_bytes()
    end = round(share * len(whole))
    ends = [stop for _, stop in chunks_of(path)]
    cut = path.parent / "cut.bin"
    cut.write_bytes(whole[:end] + tail)
    complete = 20 * max(sum(at <= end for at in ends) - 1, 0)  # the first holds no cycles
    try:
        found = numbers(cut)
    except LogError:
        assert end < ends[0]  # not even the beginning is whole: no recording
        return
    assert found[:complete] == list(range(complete))
    assert found == list(range(len(found)))


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(share=st.floats(0, 1), mask=st.integers(1, 255))
def test_a_byte_that_changed_on_the_disk_hides_cycles_and_never_alters_one(
    three_chunks: tuple[Desk, Array], share: float, mask: int
) -> None:
    desk, rows = three_chunks
    raw = bytearray(desk.files[0].read_bytes())
    start, stop = chunks_of(desk.files[0])[2]
    raw[start + 40 + round(share * (stop - start - 41))] ^= mask
    flipped = desk.folder / "flipped.bin"
    flipped.write_bytes(raw)
    found = read_columns(flipped)["actual_q"]
    assert len(found) in (40, 60)
    left = rows if len(found) == 60 else np.delete(rows, range(20, 40), axis=0)
    expected = left[:, desk.memory.slices["actual_q"]]
    assert same_bits(found, np.ascontiguousarray(expected))


def test_another_file_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="file not found"):
        files_of(tmp_path / "run-1")
    (tmp_path / "log.mcap").write_text("timestamp,actual_q_0\n")
    with pytest.raises(LogError, match=r"log\.mcap: found no MCAP file"):
        read_columns(tmp_path / "log.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert read_columns(tmp_path / "empty.mcap") == {}


def test_the_files_of_a_run_are_its_own_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    ours = ["run-1-002.mcap", "run-1-999.mcap", "run-1-1000.mcap"]
    others = ["run-1-2-001.mcap", "run-1.loop.log", "run-10-001.mcap", "run-1-003.mcap.part"]
    for name in ours + others:
        (tmp_path / name).touch()
    assert [path.name for path in files_of(tmp_path / "run-1")] == ours
    assert [path.name for path in files_of(tmp_path / "run-1-2")] == ["run-1-2-001.mcap"]
    assert segments(tmp_path, "run-1") == files_of(tmp_path / "run-1")


def test_files_change_by_size_and_a_run_reads_as_a_whole(tmp_path: Path) -> None:
    desk = Desk(tmp_path, segment_size=0.02)
    rows = desk.record(*[60] * 8)
    assert len(desk.files) >= 3
    assert all(is_whole(path) for path in desk.files)
    columns = read_columns(desk.stem)
    assert same_bits(columns["corrected_q"], rows[:, desk.memory.slices["corrected_q"]].copy())
    first = [int(last.columns["number"][-1]) for path in desk.files if (last := last_batch(path))]
    assert first == sorted(set(first))
    assert all(read_configuration(path)["segment"] == k + 1 for k, path in enumerate(desk.files))


def test_files_change_by_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(tmp_path, segment_time=1.0)
    recorder = desk.recorder()
    recorder.step(flush=True)
    assert recorder._segment is not None
    recorder._segment.opened -= 2.0
    publish(desk.memory, 5)
    recorder.step(flush=True)
    publish(desk.memory, 5)
    recorder.close()
    assert [numbers(path) for path in desk.files] == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]


def test_the_oldest_files_make_room(tmp_path: Path) -> None:
    desk = Desk(tmp_path, segment_size=0.02, keep_total=0.1)
    old = tmp_path / "run-20250101-000000-001.mcap"
    old.write_bytes(bytes(80_000))
    (tmp_path / "run-20250101-000000.loop.log").touch()
    foreign = tmp_path / "calibration.mcap"
    foreign.write_bytes(bytes(200_000))
    desk.record(*[60] * 12)
    assert not old.exists()
    assert not list(tmp_path.glob("*.loop.log"))
    assert foreign.exists()
    ours = [path for path in desk.files if path != foreign]
    assert len(ours) > 1
    assert sum(path.stat().st_size for path in ours) < 0.1e6 + 2 * 60_000


def test_a_session_is_named_anew_while_its_name_is_taken(tmp_path: Path) -> None:
    names, begin = set(), datetime(2026, 3, 1, 12, 30, 5).timestamp()
    for _ in range(3):
        name = new_session(tmp_path, begin)
        names.add(name)
        (tmp_path / f"{name}-001.mcap").touch()
        (tmp_path / f"{name}.loop.log").unlink()  # its files take the name too
    assert len(names) == 3
    assert new_session(None, begin) == "run-20260301-123005"


def test_every_so_manieth_cycle_is_counted_over_files(tmp_path: Path) -> None:
    desk = Desk(tmp_path, every=3)
    desk.record(2, 1, 5)
    assert numbers(desk.stem) == [0, 3, 6]


def test_a_recorder_that_comes_after_a_killed_one_goes_on_behind_it(desk: Desk) -> None:
    first = desk.recorder()
    publish(desk.memory, 30)
    first.step(flush=True)
    publish(desk.memory, 20)
    first.step()  # taken, not flushed: the process dies with them
    publish(desk.memory, 10)
    second = desk.recorder()
    second.close()
    assert [numbers(path) for path in desk.files] == [list(range(30)), list(range(30, 60))]
    assert second.lost == 0


def test_what_the_ring_no_longer_holds_is_reported(desk: Desk) -> None:
    from gapbridge.bridge.ipc.shared_memory import ROWS

    recorder = desk.recorder()
    publish(desk.memory, 10)
    recorder.step(flush=True)
    publish(desk.memory, ROWS)
    recorder.step(flush=True)
    recorder.close()
    found = numbers(desk.stem)
    assert recorder.lost == ROWS + 10 - len(found) > 0
    assert found[:10] == list(range(10))
    assert found[10:] == list(range(found[10], ROWS + 10))
    assert any(event.get("lost") == recorder.lost for event in desk.events)
