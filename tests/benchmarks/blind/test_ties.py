"""What looks alike: the catalogue says it, the generator shows it, the diagnosis reports it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from further import further

from benchmarks.blind.run import Command
from benchmarks.blind.ties import TABLE, Shown, answer, draw, right
from gapbridge.core.effects import CATALOGUE

pytest.importorskip("pinocchio", reason="needs the test extra: pip install -e '.[test]'")

POOR = [row for row, data in enumerate(TABLE) if data.lack]
CHEAP = [row for row in POOR if TABLE[row].effect in ("joint_slip", "torque_offset")
         or TABLE[row].channel == "wrench"]  # fmt: skip
# of a slip that such a log does not even hold: what was there all the time is an offset
NO_MOMENT = "no pose before the moment"


def shown(left: dict[str, float], free: dict[str, float], gap: float = 1e6) -> Shown:
    return Shown(gap, left, free, lambda folder: None)


def test_each_tie_of_the_catalogue_is_shown_by_data_that_cannot_separate_it():
    said = {frozenset((name, other)): data for name, effect in CATALOGUE.items()
            for other, data in effect.equivalents.items() if data != NO_MOMENT}  # fmt: skip
    drawn = {frozenset((data.effect, other)) for data in TABLE for other in data.alike}
    assert said.keys() - drawn == set()


def test_each_effect_of_the_table_is_also_drawn_where_everything_is_excited():
    excited = {(data.effect, data.channel) for data in TABLE if not data.lack}
    poor = {(data.effect, data.channel) for data in TABLE if data.lack}
    assert poor - excited == set()


@pytest.mark.parametrize("row", [CHEAP[0], *further(*CHEAP[1:])])
def test_on_poor_data_another_effect_leaves_next_to_nothing_of_the_gap(row):
    found = draw(TABLE[row], np.random.default_rng([4711, row]))
    assert {*TABLE[row].alike} <= found.same
    assert found.gap > 1e4  # it is there to be seen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "lack"), [("torque_offset", "one way"), ("payload_cog", "one constant load")]
)
def test_what_one_way_and_one_load_cannot_separate_is_reported_as_a_tie(
    tmp_path: Path, effect: str, lack: str
):
    row = next(k for k in POOR if TABLE[k].effect == effect and lack in TABLE[k].lack)
    found = draw(TABLE[row], np.random.default_rng([4711, row]))
    found.write(tmp_path)
    document = Command.parse("gapbridge diagnose")(tmp_path / "log.csv", tmp_path / "cell.yaml", ())
    named, tie = answer(document, TABLE[row])
    assert tie
    assert right(TABLE[row], found, named, tie)


def test_an_answer_is_judged_by_what_the_data_tell():
    data = next(d for d in TABLE if d.effect == "load_friction" and d.lack)
    own, other = {data.effect}, {"coulomb_friction"}
    alike = shown({"coulomb_friction": 1e-9}, {})  # less than noise
    assert right(data, alike, other, tie=True)
    assert right(data, alike, set(), tie=False)
    assert not right(data, alike, own, tie=False)
    assert not right(data, alike, other, tie=False)
    assert not right(data, alike, {"torque_constant"}, tie=True)
    nearly = shown({"coulomb_friction": 1e-3}, {})  # 1000 of chi-square tell them apart
    assert right(data, nearly, own, tie=False)
    assert right(data, nearly, own, tie=True)
    assert not right(data, nearly, other, tie=False)
    apart = shown({"coulomb_friction": 0.5}, {"torque_offset": 1e-3})
    assert right(data, apart, own, tie=False)
    assert right(data, apart, {"torque_offset"}, tie=False)  # as good, at several places
    assert not right(data, apart, other, tie=False)
    assert not right(data, apart, set(), tie=False)


def test_an_answer_is_read_from_the_channel_of_the_row():
    data = next(d for d in TABLE if d.channel == "torque")
    cause = {"effect": "coulomb_friction", "indistinguishable_from": ["torque_offset"]}
    other = {"channel": "tracking", "causes": [{"effect": "latency", "indistinguishable_from": []}]}
    document = {"channels": [other, {"channel": "torque", "causes": [cause]}]}
    assert answer(document, data) == ({"coulomb_friction"}, True)
    assert answer({"channels": [other]}, data) == (set(), False)
