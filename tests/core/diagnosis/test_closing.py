"""What it takes to close the gap everywhere stays accused, whatever its value is worth alone."""

from types import SimpleNamespace

import numpy as np
import pytest

from gapbridge.core.diagnosis import remainder

PARTS = np.repeat(np.arange(4), 5)


@pytest.fixture
def closing(monkeypatch):
    """Return a maker of a closing by the share (4,) of the gap that sets of candidates leave."""

    def made(shares, periodic=(), channel="position"):
        def squares(chosen):
            return np.asarray(shares.get(frozenset(chosen), np.ones(4)))[PARTS] ** 2

        held = SimpleNamespace(possible=True, squares=squares)
        monkeypatch.setattr(remainder, "HeldOut", lambda selection, parts: held)
        monkeypatch.setattr(remainder, "parts", lambda observation, kept: PARTS)
        candidates = [SimpleNamespace(periodic=c in periodic) for c in range(4)]
        space = SimpleNamespace(candidates=candidates)
        selection = SimpleNamespace(
            block=(), space=space, observation=SimpleNamespace(channel=channel), kept=None
        )
        return remainder._Closing(selection)

    return made


def test_two_that_close_the_gap_only_together_are_needed(closing):
    pair = closing({frozenset({0, 1}): np.full(4, 0.25)})
    assert pair.takes([0, 1], [0])
    assert pair.takes([0, 1], [1])
    assert pair.needed == {0, 1}


def test_what_others_do_as_well_is_not_needed_until_they_are_gone(closing):
    small = np.full(4, 0.25)
    either = closing(
        dict.fromkeys([frozenset({0, 1}), frozenset({0, 2}), frozenset({0, 1, 2})], small)
    )
    assert not either.takes([0, 1, 2], [2])
    assert either.takes([0, 1], [1])
    assert either.needed == {1}


def test_an_imitation_leaves_too_much_in_one_part_or_in_all(closing):
    assert not closing({frozenset({0}): [0.1, 0.1, 0.1, 0.6]}).takes([0], [0])
    assert not closing({frozenset({0}): np.full(4, 0.4)}).takes([0], [0])
    assert closing({frozenset({0}): [0.3, 0.3, 0.3, 0.4]}).takes([0], [0])


def test_a_periodic_line_is_not_needed(closing):
    line = closing({frozenset({0, 1}): np.full(4, 0.1)}, periodic=(1,))
    assert not line.takes([0, 1], [1])
    assert line.takes([0, 1], [0])


def test_of_other_channels_than_position_nothing_is_needed(closing):
    assert not closing({frozenset({0}): np.full(4, 0.1)}, channel="wrench").takes([0], [0])
