"""The journal survives a power cut: no written entry is lost, no torn entry is used."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.bridge.calibration.session.journal import (
    FILE,
    Entry,
    Journal,
    plain,
    read_entries,
)
from gapbridge.bridge.calibration.session.session import Reading, Session, entry_of, plan_of
from gapbridge.bridge.document.notes import note_texts
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.errors import InputError, RunError
from gapbridge.core.notes import Note, Reason

NOTE = Note(Reason.IDLE_LOADS, ((1.0,),))


def small_plan(stops: int = 4) -> Plan:
    free = np.zeros(6)
    poses = tuple(
        PlannedPose(i, np.full(6, 0.1 * i), i // 2, free, held_out=i == 1) for i in range(stops)
    )
    loads = (Payload(1.0, (0.0, 0.0, 0.1), "light"), Payload(5.0))
    expected = Expectation(("a",), ("m",), np.array([np.inf]), np.array([1e-3]), 1e-4, 2e-4)
    return Plan(loads, poses, expected, ((6, 1e-4),), 12.0, (NOTE,))


def reading_at(stop: int, **changed: object) -> Reading:
    given: dict[str, object] = {
        "stop": stop, "q": np.full(6, 0.1 * stop), "value": np.array([1.0, 2.0, 3.0 + stop]),
        "scatter": float("nan"), "samples": 1, "load": stop // 2, "station": 0, "target": 0,
        "approach": np.zeros(6),
    }  # fmt: skip
    return Reading(**{**given, **changed})  # type: ignore[arg-type]


def test_a_plan_reads_back_as_it_was_written(tmp_path: Path) -> None:
    plan = small_plan()
    restored = plan_of(json.loads(json.dumps(plain(entry_of(plan)), allow_nan=False)))
    assert restored.loads == plan.loads
    assert restored.bought == plan.bought
    assert note_texts(restored.notes) == note_texts(plan.notes)
    assert np.isinf(restored.expected.std[0])
    for one, other in zip(restored.poses, plan.poses, strict=True):
        np.testing.assert_array_equal(one.q, other.q)
        assert (one.load, one.held_out, one.number) == (other.load, other.held_out, other.number)


def test_a_resumed_session_has_the_state_of_its_journal(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        session = Session.of(journal)
        session.add("begun", version=1)
        session.add_plan(small_plan())
        session.add("mounted", load=0)
        for stop in (0, 1, 2):
            session.add("reading", **reading_at(stop, source=f"row {stop}").entry())
        session.add("undo", stop=2)
        session.add("skip", stop=3)
        session.add("rejected", stop=2, source="row 9")
        session.add("note", text="door opened")
    with Journal(tmp_path) as journal:
        resumed = Session.of(journal)
    assert [t.stop for t in resumed.accepted] == [0, 1]
    assert resumed.next_stop == 2
    assert (resumed.remaining, resumed.undone, resumed.mounted) == (1, 1, 0)
    assert resumed.used_sources == {"row 0", "row 1", "row 2", "row 9"}
    assert resumed.notes == ["door opened"]
    assert np.isnan(resumed.accepted[0].scatter)
    readings = resumed.readings("position")
    np.testing.assert_array_equal(readings.held_out, [False, True])
    assert readings.value.shape == (2, 3)


def changed(kind: str, **fields: object) -> Callable[[list[Entry]], None]:
    """Return what gives other fields to the first entry of a kind; None: takes them away."""

    def change(entries: list[Entry]) -> None:
        entry = next(e for e in entries if e["kind"] == kind)
        entry |= fields
        for key in [key for key, value in fields.items() if value is None]:
            del entry[key]

    return change


@pytest.mark.parametrize(
    ("row", "change"),
    [
        (1, changed("begun", time=None)),
        (2, changed("plan", plan={})),
        (3, changed("mounted", load=None)),
        (4, changed("reading", q=None)),
        (4, changed("reading", q=["nan"] * 6)),
        (4, changed("reading", q=[0.0] * 5)),
        (4, changed("reading", stop=9)),
        (4, changed("reading", load=7)),
        (5, changed("reading", value=[1.0, 2.0])),
        (5, lambda entries: entries.insert(4, entries[3])),
        (3, lambda entries: entries.pop(1)),  # the plan
        (3, lambda entries: entries.insert(2, {"kind": "undo", "stop": 0})),
    ],
)
def test_a_journal_that_was_changed_by_hand_is_refused_with_its_row(
    tmp_path: Path, row: int, change: Callable[[list[Entry]], object]
) -> None:
    with Journal(tmp_path) as journal:
        session = Session.of(journal)
        session.add("begun", version=1)
        session.add_plan(small_plan())
        session.add("mounted", load=0)
        for stop in (0, 1):
            session.add("reading", **reading_at(stop).entry())
    entries = read_entries(tmp_path / FILE)
    change(entries)
    (tmp_path / FILE).write_text("".join(json.dumps(e) + "\n" for e in entries))
    with Journal(tmp_path) as journal, pytest.raises(InputError, match=f"row {row}: found an"):
        Session.of(journal)


def test_readings_after_a_knock_belong_to_the_new_place(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        session = Session.of(journal)
        session.add_plan(small_plan())
        for stop in (0, 1, 2):
            session.add("reading", **reading_at(stop).entry())
        session.add("moved", station=1, target=0, since=1)
    with Journal(tmp_path) as journal:
        resumed = Session.of(journal)
    assert [t.station for t in resumed.accepted] == [0, 1, 1]


def test_an_entry_that_did_not_fit_on_the_disk_leaves_the_journal_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = os.write
    with Journal(tmp_path) as journal:
        journal.add("note", text="before")
        with monkeypatch.context() as full:
            full.setattr(os, "write", lambda fd, data: write(fd, data[: len(data) // 2]))
            with pytest.raises(RunError, match="the disk is full"):
                journal.add("note", text="lost")
        journal.add("note", text="after")
    assert [entry["text"] for entry in read_entries(tmp_path / FILE)] == ["before", "after"]


def test_a_folder_that_takes_no_journal_is_unusable_input(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"journal\.jsonl: cannot be written: Not a directory"):
        Journal(tmp_path / "file" / "s").open()


@given(st.integers(0, 400))
@settings(max_examples=40, deadline=None)
def test_a_journal_that_is_cut_anywhere_keeps_every_whole_line(cut: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Journal(folder) as journal:
            for i in range(8):
                journal.add("note", text=f"entry {i}")
        whole = (folder / FILE).read_bytes()
        (folder / FILE).write_bytes(whole[:cut])
        expected = whole[:cut].count(b"\n")
        with Journal(folder) as journal:
            assert len(journal.entries) == expected
            assert journal.torn == (
                cut < len(whole) and not whole[:cut].endswith(b"\n") and cut > 0
            )
            journal.add("note", text="after")
        assert len(read_entries(folder / FILE)) == expected + 1


def test_a_damaged_line_in_the_middle_is_named(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text('{"kind": "begun"}\nrubbish\n{"kind": "note"}\n')
    with pytest.raises(InputError, match="row 2: found 'rubbish'"):
        Journal(tmp_path).open()


@pytest.mark.parametrize("line", ["[1]", '{"kind": 3}', '{"time": 1.0}', "{"])
def test_a_line_that_is_no_entry_is_refused_with_its_number(tmp_path: Path, line: str) -> None:
    with Journal(tmp_path) as journal:
        journal.add("note", text="before")
    with (tmp_path / FILE).open("a") as file:
        file.write(line + "\n" + '{"kind": "note"}\n')
    with pytest.raises(InputError, match="row 2: found"):
        Journal(tmp_path).open()


def test_two_terminals_do_not_share_a_session(tmp_path: Path) -> None:
    with Journal(tmp_path), pytest.raises(InputError, match="open in another terminal"):
        Journal(tmp_path).open()


def _write_forever(folder: str, reported: int) -> None:
    with Journal(Path(folder)) as journal:
        for i in range(10**6):
            journal.add("note", number=i)
            os.write(reported, b".")  # the next step: only now may anybody rely on it


def test_acknowledged_entries_survive_a_kill(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        read, write = os.pipe()
        writer = multiprocessing.get_context("fork").Process(
            target=_write_forever, args=(str(tmp_path), write)
        )
        before = len(read_entries(tmp_path / FILE)) if (tmp_path / FILE).exists() else 0
        writer.start()
        os.close(write)
        time.sleep(float(rng.uniform(0.05, 0.3)))
        assert writer.pid is not None
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        acknowledged = 0
        while data := os.read(read, 65536):
            acknowledged += len(data)
        os.close(read)
        with Journal(tmp_path) as journal:
            new = journal.entries[before:]
        assert len(new) in (acknowledged, acknowledged + 1)
        assert [e["number"] for e in new] == list(range(len(new)))
