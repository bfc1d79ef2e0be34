"""A number that goes by a quantity is no constant of an arm, however well its mean fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from benchmarks.blind.measuring import axial_moments
from benchmarks.blind.session import play
from gapbridge.core.diagnosis.all_rows.refit_on_all_rows import (
    RefitsAtOnce,
    accused_on_all_rows,
    fitted_on_all_rows,
)
from gapbridge.core.diagnosis.constancy import not_constant
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import Check
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import Judgement
from gapbridge.core.diagnosis.periodicity import not_periodic
from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.metrology import Metrology

GAP = 9e-4  # rad, of joint 2
LINE = 12.0  # cycles a turn


def by_load(share):
    """Return the arm whose play has a part that opens with the load that the joint holds."""

    def angle(session, q):
        load = np.abs(axial_moments(small.NOMINAL, session)[:, 1])
        opened = (load / np.quantile(load, 0.8)) ** 1.5
        return play(session, 1, GAP) * (1 - share + share * opened)

    return small.turned(2, angle)


def diagnosed(share):
    session = small.session_of(0)
    log = small.log_of(session, small.readings(by_load(share), session))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    return found.channels[0]


@pytest.mark.parametrize("share", [0.0, 0.15])
def test_a_constant_is_accused_though_it_varies_a_little(share):
    channel = diagnosed(share)
    (cause,) = [c for c in channel.causes if c.effect == "backlash"]
    assert cause.joints == (2,)
    assert cause.parameters[0].value == pytest.approx(GAP, rel=0.2)


def test_play_that_opens_with_the_load_is_no_backlash():
    channel = diagnosed(1.0)
    assert not channel.causes
    assert channel.structured


def fading(fades):
    """Return the selection of an arm with a line of joint 2 that fades over the joint's range."""

    def angle(session, q):
        way = (q - q.min()) / np.ptp(q)
        return GAP * (1 - fades * way) * np.sin(LINE * q)

    session = small.session_of(0)
    log = small.log_of(session, small.readings(small.turned(2, angle), session))
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    return diagnose(small.model_of(), log, metrology).channels[0].selection


def line_in(selection):
    (own,) = [
        c for c, k in enumerate(selection.space.candidates)
        if k.periodic and k.site.joint == 2 and k.site.order == LINE
    ]  # fmt: skip
    return own


def line_of(fades):
    """Return which line of joint 2 is no constant, where one fades over the joint's range."""
    selection = fading(fades)
    own = line_in(selection)
    return not_constant(selection, [own], np.zeros((len(selection.space.y), 0)))


@pytest.mark.slow
def test_a_gears_line_is_the_same_in_every_part_of_the_range():
    assert line_of(0.0) == {}
    assert [*line_of(1.0).values()] == ["actual_q_1"]


@pytest.mark.parametrize("beside", [True, False])
def test_less_than_a_period_is_no_line_with_an_unknown(beside):
    """Any curve of one bend is a sine's piece; alone, an eccentric gear is the usual guess."""
    selection = fading(0.0)
    space = selection.space
    slow = next(
        c for c, k in enumerate(space.candidates)
        if k.periodic and k.site.joint == 2 and k.site.order == 1.0
    )  # fmt: skip
    unnamed = next(c for c, k in enumerate(space.candidates) if k.quantity == "timestamp")
    chosen = [slow, line_in(selection), *([unnamed] if beside else [])]
    found = fit(space, chosen)
    selection = replace(selection, best=found)
    q = selection.observation.quantities["actual_q_1"]
    assert np.ptp(q) / (2 * np.pi) < 0.75
    assert (slow in not_periodic(selection)) is beside
    assert line_in(selection) not in not_periodic(selection)


@pytest.mark.slow
def test_only_numbers_of_poses_are_judged():
    """An offset is the mean of whatever turns its joint, and a link's numbers have their forms."""
    selection = diagnosed(1.0).selection
    candidates = selection.space.candidates
    nothing = np.zeros((len(selection.space.y), 0))
    for family in ("joint_offset", "link_geometry", "joint_slip"):
        own = [c for c, k in enumerate(candidates) if k.family == family and k.site.joint == 2][:1]
        assert not_constant(selection, own, nothing) == {}
    (play_of_2,) = [
        c for c, k in enumerate(candidates) if k.family == "backlash" and k.site.joint == 2
    ]
    assert list(not_constant(selection, [play_of_2], nothing).values()) == ["load"]


@pytest.mark.parametrize(("fades", "kept"), [(0.0, True), (1.0, False)])
def test_all_rows_judge_whether_a_line_is_one(fades, kept):
    """A search saw a tenth of a UR10's rows: its lines helped there, and in no other series."""
    selection, model = fading(fades), small.model_of()
    line, space = line_in(selection), selection.space
    found = fit(space, (line,))
    selection = replace(
        selection, best=found, term_index=(line,), covariance=(1e-12 * np.eye(2),),
        terms=(space.candidates[line].term(found.values[0]),),
    )  # fmt: skip
    accused = Judgement((0,), True, 0.0, (), {}, ())
    whole = fitted_on_all_rows(selection, accused, selection.observation, model)
    _, decided = accused_on_all_rows(whole, accused, HeldOut(whole), RefitsAtOnce(model, False))
    assert decided.accused == ((0,) if kept else ())
    assert kept or dict(decided.withdrawn)[0].failed is Check.CONSTANT


@pytest.mark.parametrize(("slope", "place"), [(1e-3, 0.5), (2e-3, 0.3)])
def test_a_kink_in_a_joints_angle_is_no_line_of_half_a_period(slope, place):
    """An offset and a line of order 1 fit it to the noise: the log shows 0.6 of a period."""

    def kink(session, q):
        return slope * np.maximum(q - np.quantile(q, place), 0.0)

    session = small.session_of(0)
    log = small.log_of(session, small.readings(small.turned(2, kink), session))
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    channel = diagnose(small.model_of(), log, metrology).channels[0]
    assert not channel.causes
    assert channel.structured
    assert channel.depends_on[0][0] == "actual_q_1"
