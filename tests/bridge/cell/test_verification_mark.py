"""The mark of a failed verification: whatever it holds, it counts."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gapbridge.bridge.cell.verification_mark import mark_path, read_mark, remove_mark, write_mark
from gapbridge.core.errors import RunError

GARBAGE = (
    b"", b"{", b"\xff\xfe", b"[]", b"3", b"null", b'{"reason": "x"}', b"[" * 60_000,
    b'{"schema": "gapbridge.verification_failed/1", "reason": 3}',
    b'{"schema": "gapbridge.verification_failed/1", "reason": " "}',
    b'{"schema": "gapbridge.verification_failed/2", "reason": "x"}',
)  # fmt: skip


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    path = tmp_path / "press.yaml"
    path.touch()
    return path


def test_a_mark_is_read_as_it_was_written_and_removed_once(cell: Path) -> None:
    assert read_mark(cell) == ""
    path = write_mark(cell, "the zero of joint 5 moved by 10 mrad", cell.parent / "session")
    assert path == cell.with_name("press.verification_failed.json")
    assert read_mark(cell) == f"{path}: the zero of joint 5 moved by 10 mrad"
    assert remove_mark(cell)
    assert not remove_mark(cell)
    assert read_mark(cell) == ""


def test_a_link_to_a_cell_has_the_mark_of_the_cell(cell: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "link.yaml"
    link.symlink_to(cell)
    write_mark(link, "moved", tmp_path)
    assert read_mark(cell)


@pytest.mark.parametrize("data", GARBAGE)
def test_a_mark_that_makes_no_sense_counts_and_is_told_in_one_line(cell: Path, data: bytes) -> None:
    mark_path(cell).write_bytes(data)
    assert "found no mark that can be read, expected" in read_mark(cell)
    assert remove_mark(cell)


def test_folders_pipes_and_unreadable_files_count(cell: Path) -> None:
    path = mark_path(cell)
    os.mkfifo(path)
    assert "found no mark that can be read" in read_mark(cell)
    path.unlink()
    path.mkdir()
    assert "found no mark that can be read" in read_mark(cell)
    with pytest.raises(RunError, match="remove it by hand"):
        remove_mark(cell)
    path.rmdir()
    path.symlink_to(path)
    assert "cannot be read" in read_mark(cell)


def test_a_reason_is_shown_in_one_line_without_control_characters(cell: Path) -> None:
    write_mark(cell, "a\nb\x1b[31m" + "c" * 5000, cell.parent)
    reason = read_mark(cell)
    assert reason.isprintable()
    assert len(reason) < 1000
