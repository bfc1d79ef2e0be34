"""What we create is the owner's to write and nobody else's to read, whatever the umask says."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gapbridge.bridge.calibration.session.journal import Journal as SessionJournal
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.saving import save_cell
from gapbridge.bridge.document.output_file import replacing, require_folder, write_text
from gapbridge.bridge.fleet.journal import Journal as FleetJournal
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.bridge.recording.segment import Segment
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
