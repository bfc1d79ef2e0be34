"""What is printed of a correction outside the envelope."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from gapbridge.bridge.api.functions import above


@given(st.floats(1e-9, 10.0), st.floats(1e-12, 1.0), st.sampled_from([1.0, 1e3]))
@example(0.01, 1e-6, 1e3)  # "moves the TCP by 10 mm, expected at most 10 mm"
def test_a_value_beyond_a_limit_is_printed_in_enough_digits(
    limit: float, share: float, factor: float
):
    value = limit * (1 + share)
    if value * factor > limit * factor:
        text = above(value, limit, factor)
        assert float(text) > limit * factor
        assert abs(float(text) - value * factor) <= 0.006 * value * factor
    assert above(limit * 1.5, limit) == f"{limit * 1.5:.3g}"


def test_digits_are_few_where_few_show_it():
    assert above(0.0123456, 0.01, 1e3) == "12.3"
    assert above(0.010001, 0.01, 1e3) == "10.001"
