"""What the plan takes out of a block is what the codings say, number by number."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.drivers.modbus.plan import TURN, BlockPlan
from gapbridge.drivers.modbus.registers import CODES, Coding, wire_of

word = st.integers(0, 0xFFFF)


@settings(max_examples=400, deadline=None)
@given(
    st.sampled_from(sorted(CODES)), st.sampled_from(["high_first", "low_first"]),
    st.lists(word, min_size=32, max_size=32), st.permutations(range(32)),
    st.sampled_from((1.0, 1e-3, -0.25)), st.none() | st.sampled_from(("i16", "u16", "sm16")),
)  # fmt: skip
def test_a_block_gives_the_plan_what_its_codings_say(
    kind: str, order: str, registers: list[int], places: list[int], size: float, turns: str | None
) -> None:
    coding = Coding(kind, order)  # type: ignore[arg-type]
    plan, indices = BlockPlan(32), places[: 4 * coding.words]
    plan.add("position", indices, coding, [size] * 4, np.inf)
    wanted = [count * size for count in coding.decode([registers[i] for i in indices])]
    if turns is not None:
        turning, at = Coding(turns), places[28:]  # type: ignore[arg-type]
        plan.add_turns(at, turning)
        counts = turning.decode([registers[i] for i in at])
        wanted = [v + TURN * t for v, t in zip(wanted, counts, strict=True)]
    plan.add("velocity", [0], Coding("u16"), [1.0], np.inf)
    plan.compile()
    found = plan.vectors(wire_of(registers))
    if any(np.isnan(wanted)):
        assert found is None
        return
    assert found is not None
    np.testing.assert_array_equal(found["position"], wanted)
    np.testing.assert_array_equal(found["velocity"], registers[:1])


@pytest.mark.parametrize(
    ("count", "fine"), [(10, True), (11, False), (0xFFF6, True), (0xFFF5, False)]
)
def test_a_number_beyond_its_bound_is_reported(count: int, fine: bool) -> None:
    plan = BlockPlan(2)
    plan.add("position", [0, 1], Coding("i16"), [0.1, 0.1], 1.0)
    plan.compile()
    assert (plan.vectors(wire_of([0, count])) is not None) == fine
