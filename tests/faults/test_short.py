"""The table of faults in short: every family and every link, on any machine.

One try each. Patient about time, which a busy machine takes; strict about what went over the wire.
The whole table is test_matrix.py.
"""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from rigs import Rigs, judge, quiet_link

from benchmarks.faults.injection import make_fault
from benchmarks.faults.links import LINKS
from benchmarks.faults.matrix import run_alone
from benchmarks.faults.report import counted
from benchmarks.faults.row import Result
from benchmarks.faults.sequences import draw_sequence, make_sequence
from benchmarks.faults.table import FAMILIES, ROWS

KEYS = {
    "can": ("stale link", "one leap", "another commander", "flood"),
    "modbus": ("late sample", "reset", "wrong function, once", "another master", "bad reload"),
    "ur_offset": ("frozen clock", "NaN for long", "no echo", "emergency stop"),
    "ur_servoj": ("one NaN", "text messages", "empty packet", "protective stop", "loop is killed"),
}
ALONE = (("can", "SIGTERM"), ("modbus", "bad model output"))
ROW = {row.key: row for row in ROWS}


def judge_patiently(result: Result) -> None:
    """Hold a result against the table; how long a busy machine took for it is not judged."""
    judge(result, [message for message in result.wrong if not message.startswith("detected after")])


CASES = [(name, key) for name, keys in KEYS.items() for key in keys]


@pytest.mark.realtime
@pytest.mark.parametrize(("name", "key"), CASES, ids=[f"{n}-{k}" for n, k in CASES])
def test_a_fault_is_detected_and_answered(rigs: Rigs, name: str, key: str) -> None:
    judge_patiently(make_fault(rigs.of(name), ROW[key]))
    if key == KEYS[name][-1]:
        rig = rigs.of(name)
        before = rig.found.violated
        chosen = draw_sequence(random.Random(7), name, severe=0.0)
        make_sequence(rig, chosen)
        if rig.found.violated != before:
            pytest.fail(f"an invariant is broken: {rig.found.violations[before:]}")


def test_a_fault_is_not_judged_where_the_machine_was_late_unless_an_invariant_broke() -> None:
    given = ("one leap", "can piper", 0.005, None, "compensating", 0.0, 1e-4, ("not detected",))
    with pytest.raises(pytest.skip.Exception, match=r"the machine was 45 ms late.*not detected"):
        judge_patiently(Result(*given, late=0.045))
    with pytest.raises(AssertionError, match="not detected"):
        judge_patiently(Result(*given))
    with pytest.raises(pytest.fail.Exception, match=r"invariant is broken.*not detected"):
        judge_patiently(Result(*given, violated=True, late=0.045))
    assert counted([Result(*given, late=0.045), Result(*given), Result(*given[:-1])]) == (
        "3 faults made, each once, 1 not as expected, 0 with an invariant broken; "
        "1 not judged, because the machine itself was late by up to 45 ms."
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "key"), ALONE, ids=[f"{n}-{k}" for n, k in ALONE])
def test_a_fault_with_a_rig_of_its_own_is_answered(tmp_path: Path, name: str, key: str) -> None:
    judge_patiently(run_alone(ROW[key], quiet_link(name), tmp_path))


def test_every_family_and_every_link_is_among_them() -> None:
    keys = {key for _, key in (*CASES, *ALONE)}
    for family in FAMILIES:
        assert keys & {row.key for row in family.ROWS}, family.__name__
    assert set(KEYS) == set(LINKS)
    for name, key in (*CASES, *ALONE):
        assert name in ROW[key].links, (name, key)
