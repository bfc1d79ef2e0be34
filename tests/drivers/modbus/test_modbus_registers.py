"""Numbers there and back, whatever their type, word order and sign coding."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.core.errors import InvalidStateError
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import CODES, Coding
from gapbridge.drivers.modbus.schema import Mailbox
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.modbus.transport import check_answer, check_written

TYPES = sorted(CODES)


@given(st.sampled_from(TYPES), st.sampled_from(["high_first", "low_first"]), st.data())
def test_counts_come_back_from_their_registers(kind: str, order: str, data: st.DataObject) -> None:
    coding = Coding(kind, order)  # type: ignore[arg-type]
    low, high = (max(min(v, 2.0**52), -(2.0**52)) for v in coding.limits)
    number = st.floats(low, high, width=32) if kind[0] == "f" else st.integers(int(low), int(high))
    counts = data.draw(st.lists(number, min_size=1, max_size=8))
    registers = coding.encode([float(c) for c in counts])
    assert len(registers) == coding.words * len(counts)
    assert all(0 <= r <= 0xFFFF for r in registers)
    assert list(coding.decode(registers)) == counts


@pytest.mark.parametrize(
    ("kind", "order", "registers", "count"),
    [
        ("i16", "high_first", [0xFFFF], -1),
        ("sm16", "high_first", [0x8001], -1),
        ("sm16", "high_first", [0x8000], 0),
        ("i32", "high_first", [0xFFFF, 0xFFFE], -2),
        ("i32", "low_first", [0xFFFE, 0xFFFF], -2),
        ("u32", "low_first", [0x0002, 0x0001], 0x10002),
        ("u64", "low_first", [4, 3, 2, 1], 0x0001000200030004),
        ("f32", "high_first", [0x4049, 0x0FDB], struct.unpack(">f", b"\x40\x49\x0f\xdb")[0]),
    ],
)
def test_registers_read_as_manuals_say(
    kind: str, order: str, registers: list[int], count: float
) -> None:
    assert list(Coding(kind, order).decode(registers)) == [count]  # type: ignore[arg-type]


@pytest.mark.parametrize(("kind", "count"), [("i16", 32768), ("u16", -1), ("sm16", -32768)])
def test_a_number_that_does_not_fit_is_refused(kind: str, count: float) -> None:
    with pytest.raises(ValueError, match="expected"):
        Coding(kind).encode([count])  # type: ignore[arg-type]


@given(st.lists(st.integers(0, 0xFFFF), min_size=8, max_size=8), st.integers(0, 7), st.data())
def test_any_single_wrong_register_spoils_the_checksum(
    words: list[int], at: int, data: st.DataObject
) -> None:
    other = data.draw(st.integers(0, 0xFFFF).filter(lambda v: v % 65521 != words[at] % 65521))
    changed = [*words[:at], other, *words[at + 1 :]]
    assert encode.checksum(changed) != encode.checksum(words)


def test_sequence_numbers_never_come_to_zero() -> None:
    number, seen = 0, set()
    for _ in range(40000):
        number = encode.next_number(number)
        seen.add(number)
    assert 0 not in seen
    assert max(seen) == 0x7FFF


@given(st.lists(st.integers(0, 0x7FFF), min_size=10, max_size=10, unique=True), st.data())
def test_two_registers_exchanged_spoil_the_checksum(words: list[int], data: st.DataObject) -> None:
    i, j = data.draw(st.lists(st.integers(0, 9), min_size=2, max_size=2, unique=True))
    changed = words.copy()
    changed[i], changed[j] = words[j], words[i]
    difference = (i - j) * (words[i] - words[j])
    assert (encode.checksum(changed) != encode.checksum(words)) == bool(difference % 65521)


def test_lengths_and_angles_of_a_mailbox_have_their_own_counts() -> None:
    box = read_profile(ModbusSettings.shipped / "ur.yaml").write
    assert isinstance(box, Mailbox)
    box = box.model_copy(update={"length_count": 1e-6, "angle_count": 2e-6})
    offset = [1e-3, -2e-3, 3e-3, 4e-3, -5e-3, 6e-3]
    counts = encode.offset_counts(encode.units_of(box), offset)
    assert counts == [1000, -2000, 3000, 2000, -2500, 3000]
    assert encode.offset_of(box, [c % 0x10000 for c in counts]) == pytest.approx(offset)


class Answer(SimpleNamespace):
    """An answer as the library gives it."""

    def isError(self) -> bool:
        return self.function_code > 0x80


@pytest.mark.parametrize(
    ("answer", "words"),
    [({"function_code": 3, "registers": [1, 2]}, "found 2 registers, expected 3"),
     ({"function_code": 3, "registers": [1, 2, 3, 4]}, "found 4 registers, expected 3"),
     ({"function_code": 3, "registers": [1, 2, 0x10000]}, "beyond 16 bits"),
     ({"function_code": 3, "registers": [1, -2, 3]}, "beyond 16 bits"),
     ({"function_code": 4, "registers": [1, 2, 3]}, "answer to function 4, expected 3"),
     ({"function_code": 0x83, "exception_code": 2, "registers": [1, 2, 3]}, "refuses")],
)  # fmt: skip
def test_an_answer_that_was_not_asked_for_is_refused(answer: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidStateError, match=words):
        check_answer(Answer(**answer), 3, 3, "x")
    assert check_answer(Answer(function_code=3, registers=[1, 2, 3]), 3, 3, "x")


@pytest.mark.parametrize(
    ("answer", "words"),
    [({"address": 8, "count": 3}, "found address 8, expected 7"),
     ({"address": 7, "count": 2}, "found 2 written, expected 3"),
     ({"address": 7, "count": 3, "function_code": 6}, "answer to function 6, expected 16")],
)  # fmt: skip
def test_a_write_that_is_not_confirmed_is_refused(answer: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidStateError, match=words):
        check_written(Answer(**{"function_code": 16, **answer}), 16, 7, 3, "x")
    check_written(Answer(function_code=16, address=7, count=3), 16, 7, 3, "x")
