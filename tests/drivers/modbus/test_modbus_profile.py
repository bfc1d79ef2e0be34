"""Register maps that cannot be right are refused with the line that is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from contract_modbus import INVENTED

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.core.errors import InputError, InvalidStateError
from gapbridge.drivers.modbus.decode import Decoder, check_identity
from gapbridge.drivers.modbus.map import Block, compile_map
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import wire_of
from gapbridge.drivers.modbus.settings import ModbusSettings

GOOD = """\
name: an arm
joints: 6
state:
  position: {table: holding, address: 10, type: i32, scale: 0.01, unit: deg}
  velocity: {table: holding, address: 30, type: i16, scale: 1, unit: mrad/s}
status:
  - {name: ready, table: holding, address: 40, good: [1]}
write:
  mode: target_trigger
  target: {table: holding, address: 50, type: i32, scale: 0.01, unit: deg}
  trigger:
    - {table: coil, address: 5, value: 1}
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "map.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("address: 30", "address: 20", 5,
         "state.velocity.address: found holding registers 20 to 20, which overlap state.position"),
        ("address: 40", "address: 61", 10, "overlap status.1 (61 to 61, line 7)"),
        ("type: i16", "type: i17", 5, "state.velocity.type: found 'i17', expected 'bit', 'i16'"),
        ("scale: 0.01, unit: deg}\n  vel", "scale: 0, unit: deg}\n  vel", 4,
         "state.position.scale: found 0, expected a number other than zero"),
        ("joints: 6", "joints: 5", 2, "joints: found 5, expected 6: the arm has those"),
        ("joints: 6\n", "", 1, "joints: found nothing, expected how many joints it reports"),
        ("unit: mrad/s", "unit: mrad", 5, "found 'mrad', expected a unit of speed: rad/s"),
        ("table: coil", "table: discrete", 12, "expected 'coil' or 'holding'"),
        ("value: 1}", "value: 2}", 12, "write.trigger.1.value: found 2, expected 0 to 1"),
        ("mode: target_trigger", "mode: telepathy", 9, "write.mode: found 'telepathy', expected"),
        ("address: 50", "address: 65530", 10, "whose last register is beyond 65535"),
        ("  velocity:", "  velocty:", 5, "found an unknown key 'velocty'"),
        ("good: [1]", "good: []", 7, "status.1.good"),
        ("address: 10", "address: ten", 4, "state.position.address: found 'ten'"),
        ("  position: {table: holding", "  position: {table: coil", 4, "expected 'bit'"),
        ("address: 30, type: i16", "address: 30, stride: 1, type: i32", 5,
         "found 1, expected 2 or more: the registers of one i32"),
        ("name: an arm", "name: an arm\nname: two", 2, "name: found twice"),
        ("joints: 6", "joints: [", 4, "broken YAML"),
    ],
)  # fmt: skip
def test_a_mistake_is_reported_with_its_line(
    tmp_path: Path, old: str, new: str, line: int, words: str
) -> None:
    assert old in GOOD
    path = written(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        read_profile(path, 6)
    text = str(caught.value)
    assert text.startswith(f"{path}, line {line}: "), text
    assert words in text
    assert "\n" not in text


def test_a_list_is_no_map(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 1: found no keys, expected a profile \(name: "):
        read_profile(written(tmp_path, "- a"))


def test_the_good_map_is_taken(tmp_path: Path) -> None:
    compiled = compile_map(read_profile(written(tmp_path, GOOD), 6))
    assert compiled.fast == (Block("holding", 10, 31),)
    wanted = {("holding", a) for a in range(50, 62)} | {("coil", 5)}
    assert compiled.writable == wanted


@pytest.mark.parametrize(
    "path", [*sorted(ModbusSettings.shipped.glob("*.yaml")), INVENTED], ids=lambda p: p.stem
)
def test_shipped_maps_are_read_in_blocks_that_hold_all_they_need(path: Path) -> None:
    profile = read_profile(path)
    compiled = compile_map(profile)
    assert all(block.count <= 125 for block in (*compiled.fast, *compiled.slow))
    if path.stem in ("ur", "elite_ec"):
        assert len(compiled.fast) == 1
        assert not compiled.slow
    if profile.write.mode == "read_only":
        assert not compiled.writable


STRIDES = """\
name: an arm
joints: 6
state:
  position: {table: holding, address: 10, type: i16, scale: 0.01, unit: deg, stride: 2}
write: {mode: read_only}
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("joints: 6\n", "joints: 6\ngaps: false\n",
         "line 5: state.position.stride: found registers without a meaning between the numbers"),
        ("stride: 2", "stride: 30", "line 4: state.position.address: found registers 10 to 160"),
    ],
)  # fmt: skip
def test_a_vector_that_no_single_request_can_read_is_refused(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        read_profile(written(tmp_path, STRIDES.replace(old, new)), 6)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("stride: 2", "stride: 24"),
        ("stride: 2", "turns: {address: 130, type: i32}"),  # the 125th register is amid these
        ("write:", "  velocity: {table: holding, address: 11, type: i16, scale: 1, unit: deg/s,"
         " stride: 2}\nwrite:"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("gaps", [True, False])
def test_whatever_map_is_taken_can_be_decoded(
    tmp_path: Path, old: str, new: str, gaps: bool
) -> None:
    text = STRIDES.replace(old, new).replace("joints: 6", f"joints: 6\ngaps: {str(gaps).lower()}")
    if not gaps and "stride: 24" in new:
        return  # refused, see above
    profile = read_profile(written(tmp_path, text), 6)
    compiled = compile_map(profile)
    sample = Decoder(profile, compiled).decode([bytes(2 * b.count) for b in compiled.blocks])
    assert sample.vectors["position"].tolist() == [0.0] * 6


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ("offset: 0.1", "limits.offset: found 0.1 m, expected at most 0.032767"),
        ("offset_rotation: 0.2", "limits.offset_rotation: found 0.2 rad, expected at most 0.0327"),
        ("offset: 0.03", ""),
    ],
)
def test_limits_beyond_a_mailboxs_registers_are_refused(
    tmp_path: Path, limits: str, words: str
) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(
        "robot: {model: ur10e}\n"
        "link: {driver: modbus, profile: ur, host: 127.0.0.2}\n"
        f"limits: {{{limits}}}\n"
    )
    if not words:
        assert read_configuration(cell).settings.limits.offset == 0.03
        return
    with pytest.raises(InputError, match=f"line 3: {words}"):
        read_configuration(cell)


def test_a_map_without_gaps_is_read_run_by_run(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD.replace("joints: 6", "joints: 6\ngaps: false"))
    compiled = compile_map(read_profile(path, 6))
    assert compiled.fast == (Block("holding", 10, 12), Block("holding", 30, 6))
    assert compiled.slow == (Block("holding", 40, 1),)


def test_a_controller_is_known_by_a_register_amid_its_state(tmp_path: Path) -> None:
    mark = "identity:\n  - {name: version, table: holding, address: 25, good: [7]}\n"
    profile = read_profile(written(tmp_path, GOOD + mark), 6)
    compiled = compile_map(profile)
    assert compiled.fast[0].holds("holding", 25, 1)
    check_identity(profile, compiled, [wire_of([7])])
    with pytest.raises(InvalidStateError, match="found 8, expected 7"):
        check_identity(profile, compiled, [wire_of([8])])
