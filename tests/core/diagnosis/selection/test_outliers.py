"""Outliers: a tracker's glitch is excluded and reported, and becomes no cause."""

from __future__ import annotations

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import ChannelFinding, Outliers
from gapbridge.core.metrology import Metrology

REGISTERED = Metrology(registered=True, sigma=small.SIGMA)
GLITCHES = {11: (3e-3, 1e-3, -2e-3), 40: (-6e-3, 2e-3, 4e-3)}  # row from 0: m


def with_glitches(effect: str, glitches=GLITCHES, registered: bool = True):
    session = small.session_of(0)
    read = small.readings(small.REAL[effect], session, 0, registered)
    for row, off in glitches.items():
        read[row] += off
    metrology = Metrology(registered=registered, sigma=small.SIGMA)
    return diagnose(small.model_of(), small.log_of(session, read), metrology)


@pytest.mark.parametrize(
    ("effect", "registered"), [("none", True), ("none", False), ("backlash", True)]
)
def test_glitches_become_no_cause_and_are_reported_with_their_rows(effect, registered):
    found = with_glitches(effect, registered=registered)
    (channel,) = found.channels
    assert [c.effect for c in channel.causes] == ([] if effect == "none" else [effect])
    assert not channel.structured
    assert set(np.flatnonzero(~channel.selection.kept)) == set(GLITCHES)
    (reported,) = [f for f in found.findings if isinstance(f, ChannelFinding)]
    assert reported == ChannelFinding("position", Outliers(((13, ""), (42, ""))))
    assert channel.remaining_rms_held_out == pytest.approx(small.FLOOR, rel=0.2)
    assert channel.gap_max < 2e-3  # the glitches are no part of the gap


def test_parameters_are_those_without_the_glitches():
    plain = small.diagnosed("backlash").channels[0].causes[0].parameters[0]
    outlier = with_glitches("backlash").channels[0].causes[0].parameters[0]
    assert abs(outlier.value - plain.value) < 1.5 * plain.std
    assert outlier.std == pytest.approx(plain.std, rel=0.3)


def test_a_third_of_the_readings_is_no_bad_luck():
    """What befalls every third pose becomes no cause, and is admitted."""
    rows = np.arange(0, 60, 3)
    rng = np.random.default_rng(0)
    found = with_glitches("none", dict(zip(rows, rng.normal(0, 3e-3, (20, 3)), strict=True)))
    (channel,) = found.channels
    assert set(channel.outliers) == set(rows)
    assert channel.causes == ()
    assert found.verdict == "unexplained"
    assert channel.p_value == 0.0


def test_a_jump_of_the_instrument_is_structure_and_no_bad_luck():
    """The last poses all moved by the same: somebody knocked the tracker."""
    found = with_glitches("none", dict.fromkeys(range(45, 60), (4e-4, -3e-4, 2e-4)))
    (channel,) = found.channels
    assert channel.causes == ()
    assert channel.structured
    assert "timestamp" in [name for name, _ in channel.depends_on[:3]]
