"""The folder of recordings: the order of its files, and which of them make room."""

from __future__ import annotations

from pathlib import Path

from recorded import SESSION

from gapbridge.bridge.recording.finishing import unfinished
from gapbridge.bridge.recording.folder import next_path, prune, segments

OTHER = "run-20260102-080000"
MB = 1_000_000


def files(folder: Path, session: str, *numbers: int, size: int = MB) -> list[Path]:
    """Write files of a run, cut off before their summary."""
    paths = [folder / f"{session}-{number:03d}.mcap" for number in numbers]
    for path in paths:
        path.write_bytes(bytes(size))
    return paths


def test_the_oldest_of_more_than_a_thousand_files_make_room(tmp_path: Path) -> None:
    paths = files(tmp_path, SESSION, *range(996, 1004))
    assert prune(tmp_path, SESSION, 3.0) == paths[:5]
    assert segments(tmp_path, SESSION) == paths[5:]
    assert next_path(tmp_path, SESSION).name == f"{SESSION}-1004.mcap"


def test_a_run_that_began_in_the_same_second_is_another_one(tmp_path: Path) -> None:
    own, other = files(tmp_path, SESSION, 1), files(tmp_path, f"{SESSION}-2", 1)
    assert prune(tmp_path, SESSION, 1.0) == other
    assert segments(tmp_path, SESSION) == own


def test_files_that_were_cut_off_are_finished_in_the_order_of_their_numbers(
    tmp_path: Path,
) -> None:
    paths = files(tmp_path, SESSION, 998, 999, 1000)
    assert unfinished(tmp_path) == paths
