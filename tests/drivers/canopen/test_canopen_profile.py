"""Profiles are data: the shipped ones are sound, and a wrong one is reported with its line."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from gapbridge.core.errors import InputError
from gapbridge.drivers.canopen.configure import interpolation_period
from gapbridge.drivers.canopen.objects import Address
from gapbridge.drivers.canopen.profile import read_profile
from gapbridge.drivers.canopen.settings import CanopenSettings

NAMES = sorted(path.stem for path in CanopenSettings.shipped.glob("*.yaml"))


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copy(CanopenSettings.shipped / "cia402.eds", tmp_path)
    return Path(shutil.copy(CanopenSettings.shipped / "cia402.yaml", tmp_path / "mine.yaml"))


def test_each_nodes_dictionary_is_its_own_and_follows_the_file(copy: Path) -> None:
    path = copy.with_name("cia402.eds")
    eds = read_profile(copy, 6).eds
    first, second, other = eds.dictionary(3), eds.dictionary(3), eds.dictionary(4)
    assert other[0x1800][1].default == first[0x1800][1].default + 1  # $NODEID+0x180
    first[0x6041].default = 7
    assert second[0x6041].default != 7
    assert eds.dictionary(3)[0x6041].default != 7
    path.write_text(path.read_text().replace("Statusword", "Another name"))
    assert eds.dictionary(3)[0x6041].name == "Another name"


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_profile_has_six_drives_and_puts_counts_back_where_they_came_from(
    name: str,
) -> None:
    profile = read_profile(CanopenSettings.shipped / f"{name}.yaml", 6)
    q = np.linspace(-2.0, 2.0, 6)
    count = 1.0 / np.abs(profile.counts_per_radian)
    assert np.abs(profile.angles(profile.counts(q)) - q).max() <= 0.5 * count.max() + 1e-12
    assert len(set(profile.nodes)) == 6


def test_an_lwa4p_count_is_a_thousandth_of_a_degree() -> None:
    profile = read_profile(CanopenSettings.shipped / "lwa4p.yaml", 6)
    assert profile.nodes == (3, 4, 5, 6, 7, 8)
    assert profile.angles(np.full(6, 90_000.0)) == pytest.approx(np.pi / 2)
    assert profile.mode_number == 7
    assert [layout.cob_id(3) for layout in profile.tpdo] == [0x183, 0x383]
    assert [layout.cob_id(3) for layout in profile.rpdo] == [0x203]


def test_direction_gear_and_zero_are_the_joints_own(copy: Path) -> None:
    line = "{node: 2, counts_per_turn: 131072, gear: 121, direction: -1, zero: 0.0"
    copy.write_text(copy.read_text().replace(line, line.replace("zero: 0.0", "zero: 0.5")))
    q = read_profile(copy).angles(np.full(6, 131072.0))
    assert q[0] == pytest.approx(2 * np.pi / 121)
    assert q[1] == pytest.approx(0.5 - 2 * np.pi / 121)
    assert q[2] == pytest.approx(2 * np.pi / 101)


WRONG = [
    ("node: 2,", "node: 1,", "joints.2.node: found 1 again"),
    ("node: 2,", "node: 127,", "joints.2.node: found 127, expected another than heartbeat"),
    ("node: 2,", "node: 200,", "joints.2.node: found 200, expected 127 or less (node id)"),
    ("node: 2, counts_per_turn: 131072", "node: 2, counts_per_turn: 0", "counts_per_turn: found 0"),
    ("gear: 51, direction: -1", "gear: .nan, direction: -1", "joints.4.gear: found nan"),
    ("gear: 51, direction: -1", "gear: 51, direction: 2", "joints.4.direction: found 2"),
    ("gear: 51, direction: -1", "geer: 51, direction: -1", "known; did you mean 'gear'?"),
    ("mode: cyclic synchronous position", "mode: torque", "mode: found 'torque'"),
    ("eds: cia402.eds", "eds: gone.eds", "eds: "),
    ("eds: cia402.eds", "eds: mine.yaml", "expected a file ending in .eds or .dcf"),
    ("eds: cia402.eds", "", "eds: found nothing, expected the drives' EDS"),
    ("[Statusword, Position", "[Statusword, Statusword, Position", "'Statusword' again"),
    ("[Statusword, Position", "[Statuswort, Position", "(did you mean 'Statusword'?)"),
    ("[Statusword, Position", "[Statusword, 0x2001, Position", "'0x2001', expected an object of"),
    ("Controlword, Target", "Controlword, Statusword, Target", "allows in no RPDO"),
    ("[Statusword, Position actual value]", "[Statusword]", "no 'Position actual value'"),
    ("[Controlword, Target position]", "[Controlword]", "rpdo: found no 'Target position'"),
    ("[Statusword, Pos", "[Statusword, Following error actual value, Pos", "found 80 bits"),
    ("  2: [Velocity", "  5: [Velocity", "tpdo.5: found 5"),
    ("sync_period: 0.004", "sync_period: 0.004\nsync_window: 0.004", "expected less than sync_per"),
    ("drives_wait: 0.25", "drives_wait: 0.06", "heartbeat.drives_wait: found 0.06 s"),
    ("drives: 0.1", "drives: 0.0004", "heartbeat.drives: found 0.0004, expected"),
    ("drives: 0.1", "drives: 70", "heartbeat.drives: found 70, expected"),
    ("drives_wait: 0.25", "drives_wait: 0.0004", "found 0.0004 s, expected 0 or at least 0.001"),
    ("lost_after: 0.3", "lost_after: 0.1", "expected at least 1.5 times heartbeat.drives"),
    ("name: six", "name: x\nname: six", "found twice"),
]


@pytest.mark.parametrize(("old", "new", "phrase"), WRONG)
def test_a_wrong_profile_is_refused_with_file_line_and_key(
    copy: Path, old: str, new: str, phrase: str
) -> None:
    text = copy.read_text()
    assert old in text
    copy.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        read_profile(copy)
    message = str(caught.value)
    assert message.startswith(f"{copy}, line ") or "found twice" in message
    assert phrase in message
    assert "\n" not in message


def test_an_arm_with_other_joints_is_refused() -> None:
    with pytest.raises(InputError, match=r"joints: found 6, expected 7: the arm has those"):
        read_profile(CanopenSettings.shipped / "cia402.yaml", 7)


def test_an_eds_that_is_no_drives_is_refused(copy: Path) -> None:
    eds = copy.with_name("cia402.eds")
    eds.write_text(eds.read_text().replace("0x6041", "0x6043").replace("[6041]", "[6043]"))
    with pytest.raises(InputError, match="no Statusword"):
        read_profile(copy)


def test_an_eds_that_was_corrected_is_read_anew(copy: Path) -> None:
    eds = copy.with_name("cia402.eds")
    good = eds.read_text()
    start = good.index("[6077]")
    eds.write_text(good[:start] + good[good.index("[", start + 1) :])
    with pytest.raises(InputError, match="Torque actual value"):
        read_profile(copy)
    eds.write_text(good)
    assert read_profile(copy).eds.has(Address(0x6077, 0))


def test_a_broken_eds_is_reported_in_one_line(copy: Path) -> None:
    copy.with_name("cia402.eds").write_bytes(b"\xff\xfe[garbage\n=\n")
    with pytest.raises(InputError, match="broken EDS"):
        read_profile(copy)


def test_a_vendor_object_is_mapped_by_its_address(copy: Path) -> None:
    copy.write_text(copy.read_text().replace("Torque actual value, Modes of", "0x60FD] #"))
    entries = read_profile(copy).tpdo[1].entries
    assert [entry.name for entry in entries] == ["Velocity actual value", "Digital inputs"]


def test_a_profile_is_named_or_a_path_from_the_cells_folder(copy: Path) -> None:
    found = CanopenSettings(profile="mine.yaml").located(copy.parent)
    assert found.profile_path == copy
    with pytest.raises(InputError, match="expected one of cia402, lwa4p"):
        CanopenSettings(profile="lwa4").located(copy.parent)


@pytest.mark.parametrize(("period", "value"), [(0.01, (10, -3)), (0.004, (4, -3)), (5e-4, (5, -4))])
def test_an_interpolation_time_period_is_a_byte_and_a_power_of_ten(
    period: float, value: tuple[int, int]
) -> None:
    assert interpolation_period(period) == value


def test_a_sync_period_that_no_byte_holds_is_refused() -> None:
    with pytest.raises(InputError, match=r"link.rate: found 93"):
        interpolation_period(1 / 93)
