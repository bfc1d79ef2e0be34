"""All links as one cause: never behind what the same set makes of them, whatever a search finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.selection import geometry
from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.metrology import Metrology

STRETCHED = tuple(
    replace(row, a=row.a + da, d=row.d + dd, alpha=row.alpha + turn)
    for row, da, dd, turn in zip(
        small.NOMINAL.rows, (6e-4, -7e-4, 0.0), (5e-4, 4e-4, 0.0), (7e-4, -6e-4, 0.0), strict=True
    )
)


@pytest.fixture(scope="module")
def singles():
    """Return the space of an arm whose links are all off, and the set of two links singly."""
    session = small.session_of(0)
    real = replace(small.REAL["joint_offset"], rows=STRETCHED)
    log = small.log_of(session, small.readings(real, session))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    space = found.channels[0].selection.space
    own = [
        c for c, k in enumerate(space.candidates)
        if k.family == "link_geometry" or (k.family == "joint_offset" and k.site.joint == 2)
    ]  # fmt: skip
    return space, fit(space, own)


def test_links_are_kept_if_the_search_with_them_finds_nothing(singles, monkeypatch):
    space, best = singles
    worse = replace(fit(space, ()), score=np.inf)
    monkeypatch.setattr(geometry, "screened_search", lambda *_, **__: worse)
    _, found, links = geometry.with_links(space, replace(best, score=best.score + 100), ())
    block = geometry.link_candidates(space)
    assert set(links) == set(block)
    assert not set(found.chosen) & set(block)
    assert {space.candidates[c].family for c in block} == {"link_geometry", "joint_offset"}


def test_links_that_pay_less_than_the_set_are_no_cause(singles):
    space, best = singles
    near, found, links = geometry.with_links(space, replace(best, score=-1e9), ())
    assert near is space
    assert found.score == -1e9
    assert links == {}


def test_joint_zeros_have_a_prior_of_their_own(singles):
    """An IRB 120's lengths are machined, its zeros are off by up to 35 mrad."""
    space, _ = singles
    block = geometry.link_candidates(space)
    rng = np.random.default_rng(0)
    times = {"link_geometry": 1.0, "joint_offset": 20.0}
    found = []
    for _ in range(20):
        drawn = sum(
            space.columns([c])[:, k] * rng.normal() * times[space.candidates[c].family]
            * {"m": 5e-4, "rad": 1e-3}[p.unit]
            for c in block
            for k, p in enumerate(space.candidates[c].parameters)
        )  # fmt: skip
        sigma = geometry.prior(replace(space, y=drawn + rng.normal(size=len(space.y))), block, ())
        found.append([max(max(sigma[c]) for c in block if space.candidates[c].family == family)
                      / 1e-3 for family in times])  # fmt: skip
    links, zeros = np.median(found, axis=0)
    assert links <= 2.0
    assert 8.0 <= zeros <= 32.0


@pytest.mark.parametrize(("times", "least", "most"), [(1.0, 1.0, 2.0), (6.0, 4.0, 8.0)])
def test_the_size_of_the_links_errors_is_the_most_likely_one(singles, times, least, most):
    space, _ = singles
    block = geometry.link_candidates(space)
    rng = np.random.default_rng(0)
    found = []
    for _ in range(20):
        drawn = sum(
            space.columns([c])[:, k] * rng.normal() * times * {"m": 5e-4, "rad": 1e-3}[p.unit]
            for c in block
            for k, p in enumerate(space.candidates[c].parameters)
        )
        noisy = replace(space, y=drawn + rng.normal(size=len(space.y)))
        sigma = geometry.prior(noisy, block, ())
        found.append(float(max(sigma[block[0]]) / 1e-3))
    assert least <= np.median(found) <= most


def test_nominal_parameters_of_a_withdrawn_link_are_ignored(singles):
    """All rows of a UR10 let a link fall of which a twist had been held."""
    space, _ = singles
    gone, kept, *_ = block = geometry.link_candidates(space)
    held = {c: np.arange(len(space.candidates[c].parameters)) == 0 for c in (gone, kept)}
    sigma = geometry.prior(space, block[1:], (), held)
    assert set(sigma) == set(block[1:])
    assert sigma[kept][0] < 1e-6 * max(sigma[kept])
