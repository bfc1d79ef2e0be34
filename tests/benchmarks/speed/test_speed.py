"""The speed benchmark itself: peers compute the same, turns are counted, figures can be written."""

from __future__ import annotations

import json

import pytest

from benchmarks.speed import __main__ as command
from benchmarks.speed import geometry, rows, setpoint
from benchmarks.speed.sides import Side, compared, interleaved


def test_sides_take_turns_and_each_begins_as_often():
    order: list[str] = []
    sides = [Side(name, lambda name=name: order.append(name)) for name in "ab"]
    figures = interleaved(sides, 4)
    assert order == [*"ab", *"ab", *"ba", *"ab", *"ba"]  # one round of each is not timed
    assert figures["a"]["rounds"] == 4


def test_a_ratio_is_the_peers_time_by_ours():
    def spun(turns: int) -> float:
        return sum(float(k) for k in range(turns))

    sides = [Side("ours", lambda: spun(20_000)), Side("peer", lambda: spun(100_000))]
    found = compared("row", "goal", interleaved(sides, 7), [("peer", "ours")])
    assert 2.5 < found["ratios"][0]["median"] < 10
    json.dumps(command._short(found))
    assert any("peer / ours" in line for line in command.lines(found))


@pytest.mark.slow
def test_every_way_to_a_setpoint_gives_the_same_numbers():
    made = setpoint.sides()  # compares the peers with the linear form
    assert {setpoint.EXACT, setpoint.PINOCCHIO, setpoint.GLUED, setpoint.NUMPY} <= set(made)


def test_the_fit_of_many_rows_is_qrs():
    found = rows.fit(4000, 1)
    assert found["off_qr"] < 1e-9
    assert found["memory_MB"]["ours"] < 10


@pytest.mark.slow
def test_both_ways_to_a_geometry_end_at_the_same_optimum():
    found = geometry.whole(40)
    assert found["cost_m2"]["ours"] == pytest.approx(found["cost_m2"]["theirs"], rel=1e-6)
