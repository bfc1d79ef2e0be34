"""A session is resumed only with its own arm and instrument."""

from __future__ import annotations

from pathlib import Path

import pytest

from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.session.folders import check_start, start_entry
from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.core.errors import InputError

LINK = "link: {driver: ur_rtde, host: 192.168.0.10}\n"
GAUGE = "{kind: dial_gauge, unit: mm, zero: 250.0}"


def cell_of(folder: Path, link: str, serial: str, instrument: str, name: str = "cell.yaml") -> Cell:
    path = folder / name
    path.write_text(
        "robot: {model: ur10e}\n" + link
        + f"calibration: {{serial: '{serial}', instrument: {instrument}}}\n", encoding="utf-8",
    )  # fmt: skip
    return load_cell(path)


def refusal(before: Cell, now: Cell) -> str:
    """Return why a session that was started with one cell cannot go on with another, as text."""
    entry = start_entry(before, SessionOptions("whole", None, before.calibration.instrument))
    options = SessionOptions("whole", None, now.calibration.instrument)
    try:
        check_start(entry, now, options, Path("sessions/one"))
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("link", "serial", "instrument", "why"),
    [
        (LINK.replace(".10", ".11"), "A-1", GAUGE, "link: found 'host 192.168.0.11', expected"),
        (LINK, "B-2", GAUGE, "calibration.serial: found 'B-2', expected 'A-1'"),
        (LINK, "A-1", GAUGE.replace("250.0", "251.0"), "zero is 0.251 m, expected 0.25 m"),
        (LINK, "A-1", "{kind: dial_gauge, unit: mm}", "zero is to be estimated, expected 0.25 m"),
        (LINK, "A-1", "{kind: point}", "readings of kind distance, expected point"),
    ],
)
def test_another_arm_or_zero_is_refused(
    tmp_path: Path, link: str, serial: str, instrument: str, why: str
) -> None:
    before = cell_of(tmp_path, LINK, "A-1", GAUGE)
    now = cell_of(tmp_path, link, serial, instrument, "other.yaml")
    assert why in refusal(before, now)
    assert "\n" not in refusal(before, now)


@pytest.mark.parametrize(
    ("before", "now"),
    [("{kind: sphere, radius: 0.03}", "{kind: sphere}"),
     ("{kind: sphere}", "{kind: sphere, radius: 0.03}")],
)  # fmt: skip
def test_another_radius_is_refused(tmp_path: Path, before: str, now: str) -> None:
    found = refusal(cell_of(tmp_path, "", "", before), cell_of(tmp_path, "", "", now))
    assert "radius is" in found


@pytest.mark.parametrize(
    ("link", "serial", "instrument"),
    [
        (LINK, "A-1", GAUGE),
        ("", "", GAUGE),  # given later, or no longer
        (LINK.replace("ur_rtde", "modbus, profile: ur"), "A-1", GAUGE),
        (LINK, "A-1", "{kind: dial_gauge, unit: m, zero: 0.25, serial: new}"),
    ],
)
def test_a_copy_of_the_cell_resumes_it(
    tmp_path: Path, link: str, serial: str, instrument: str
) -> None:
    before = cell_of(tmp_path, LINK, "A-1", GAUGE)
    now = cell_of(tmp_path, link, serial, instrument, "copy.yaml")
    assert refusal(before, now) == ""
    assert refusal(now, before) == ""


def test_changed_loads_are_refused_in_any_order(tmp_path: Path) -> None:
    def cell(loads: str) -> Cell:
        path = tmp_path / "cell.yaml"
        path.write_text(
            f"robot: {{model: ur10e}}\ncalibration: {{loads: {loads}}}\n", encoding="utf-8"
        )
        return load_cell(path)

    light, heavy = "{mass: 1.0}", "{mass: 9.0, cog: [0.0, 0.0, 0.1]}"
    before = cell(f"[{light}, {heavy}]")
    assert "calibration.loads: found them changed" in refusal(before, cell(f"[{light}]"))
    other = cell(f"[{light}, {heavy.replace('0.1', '0.12')}]")
    assert "calibration.loads: found them changed" in refusal(before, other)
    assert refusal(before, cell(f"[{heavy}, {light}]")) == ""
