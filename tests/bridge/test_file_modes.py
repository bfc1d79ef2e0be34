"""What we create is the owner's to write and nobody else's to read, whatever the umask says."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gapbridge.bridge.calibration.session.journal import Journal as SessionJournal
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.saving import save_cell
from gapbridge.bridge.document.output_file import (
    replacing,
    require_folder,
    require_writable,
    write_text,
    write_together,
)
from gapbridge.bridge.fleet.journal import Journal as FleetJournal
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.errors import InputError, RunError
from gapbridge.drivers.clock import SYSTEM

CELL = "robot: {model: ur10e}\npayload: {mass: 5.0}\n"


@pytest.fixture(autouse=True)
def open_umask() -> Iterator[None]:
    """A umask that takes nothing away: the code itself has to."""
    before = os.umask(0)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def recording(path: Path) -> None:
    Segment(path, slices_of(6), [state.name for state in State], clock=SYSTEM).close()


def session_journal(path: Path) -> None:
    with SessionJournal(path.parent) as journal:
        journal.path.rename(path)


def fleet_journal(path: Path) -> None:
    with FleetJournal(path, SYSTEM):
        pass


def cell(path: Path) -> None:
    given = path.with_name("given.yaml")
    given.write_text(CELL)
    save_cell(load_cell(given), path)


@pytest.mark.parametrize("make", [recording, session_journal, fleet_journal, cell])
def test_a_new_file_is_0640(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "made"
    make(path)
    assert mode(path) == 0o640


def test_a_new_folder_is_0750(tmp_path: Path) -> None:
    require_folder(tmp_path / "folder", "--out")
    assert mode(tmp_path / "folder") == 0o750


def test_what_breaks_off_leaves_the_old_file_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("old")

    def half() -> None:
        with replacing(path) as file:
            file.write(CELL)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_replaced_through_a_link_leaves_the_link(tmp_path: Path) -> None:
    path, link = tmp_path / "cell.yaml", tmp_path / "current.yaml"
    path.write_text("old")
    link.symlink_to(path)
    write_text(link, CELL)
    assert link.is_symlink()
    assert path.read_text() == CELL


@pytest.mark.parametrize("kept", [0o600, 0o644])
def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(CELL)
    path.chmod(kept)
    write_text(path, CELL)
    assert mode(path) == kept


def test_of_files_that_belong_together_all_are_replaced_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [tmp_path / name for name in ("diagnosis.json", "report.html")]
    assert write_together(dict.fromkeys(paths, "old")) == paths

    def full(_: int) -> None:  # at the second file
        if (tmp_path / f".report.html.{os.getpid()}.part").exists():
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match=r"report\.html: cannot be written: No space left"):
        write_together(dict.fromkeys(paths, b"new"))
    assert [path.read_text() for path in paths] == ["old", "old"]
    assert sorted(tmp_path.iterdir()) == paths


def test_what_takes_no_file_is_noticed_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dangling = tmp_path / "o.csv"
    dangling.symlink_to(tmp_path / "none" / "o.csv")
    longest = tmp_path / f"{'x' * 251}.csv"  # alone it is short enough
    for path, reason in ((dangling, "No such file"), (longest, "File name too long")):
        with pytest.raises(InputError, match=f"{path.name}: cannot be written: {reason}"):
            require_writable(path)
    assert require_writable(tmp_path / "p.csv") == tmp_path / "p.csv"
    assert list(tmp_path.iterdir()) == [dangling]
    monkeypatch.setattr(os, "open", no_space)
    with pytest.raises(InputError, match=r"p\.csv: cannot be written: No space left"):
        require_writable(tmp_path / "p.csv")


def no_space(*_: object) -> int:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_working_folder_that_was_deleted_takes_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(InputError, match=r"o\.csv: cannot be written: No such file"):
        require_writable(Path("o.csv"))
    with pytest.raises(RunError, match=r"o\.csv: cannot be written: No such file"):
        write_text(Path("o.csv"), "")
