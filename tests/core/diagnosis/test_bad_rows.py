"""Bad rows: `fit` and `diagnose` exclude the same, come to the same, and accuse nothing by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small
from further import further

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

SOFT = replace(
    small.NOMINAL, axial=np.array(small.KIND.axial), radial=np.array(small.KIND.radial)
)  # fmt: skip
SMALLEST, LARGEST = 1e-3, 2e-2  # m, how far a bad row is off


@pytest.mark.parametrize(
    ("seed", "poses", "bad", "registered"),
    [(3, 40, 10, False),
     *further((0, 33, 1, True), (1, 33, 5, True), (2, 33, 10, True), (4, 60, 3, False),
              (5, 60, 10, False), (6, 70, 20, True))],
)  # fmt: skip
def test_fit_and_diagnose_agree_on_bad_rows(seed, poses, bad, registered):
    rng = np.random.default_rng(seed)
    session = small.session_of(seed, replace(small.PLAN, poses=poses))
    read = small.readings(SOFT, session, seed, registered)
    rows = np.sort(rng.choice(len(read), bad, replace=False))
    way = rng.normal(size=(bad, 3))
    size = rng.uniform(SMALLEST, LARGEST, (bad, 1))
    read[rows] += way / np.linalg.norm(way, axis=1, keepdims=True) * size
    log, metrology = small.log_of(session, read), Metrology(registered, small.SIGMA)
    fitted = identify_compliance(small.model_of(), log, metrology)
    (channel,) = diagnose(small.model_of(), log, metrology).channels
    assert set(rows) == set(fitted.outliers) == set(channel.outliers)
    assert {c.effect for c in channel.causes} <= {"axial_compliance", "radial_compliance"}
    assert channel.remaining_rms < 1.3 * small.FLOOR
    own = {"axial_compliance": (fitted.axial, fitted.std_axial),
           "radial_compliance": (fitted.radial, fitted.std_radial)}  # fmt: skip
    for term in (term for cause in channel.causes for term in cause.terms):
        value, std = (v[term.site.joint - 1] for v in own[term.effect])
        (found,) = (p for c in channel.causes for p in c.parameters
                    if p.name == f"{term.effect}_{term.site.joint}")  # fmt: skip
        assert abs(found.value - value) < 3 * np.hypot(found.std, std)


@pytest.mark.parametrize(("poses", "bad", "seed"), [(4, 1, 2), (4, 2, 0), (4, 2, 2), (5, 2, 1)])
@pytest.mark.filterwarnings("error")
def test_bad_rows_among_the_fewest_poses_end_no_diagnosis_and_accuse_nothing(poses, bad, seed):
    rng, model = np.random.default_rng(seed), Model(builtin_arm("ur10e"))
    q = rng.uniform(-2, 2, (poses, 6))
    measured = model.predict(q).position + rng.normal(size=(poses, 3)) * 3e-5
    measured[rng.permutation(poses)[:bad]] += rng.normal(size=(bad, 3)) * 0.05
    log = Log("log", {"actual_q": q, "measured_position": measured}, 6)
    (channel,) = diagnose(model, log, Metrology(registered=False)).channels
    assert not channel.causes
    observation = channel.selection.observation
    N, k, p = observation.nuisance.shape
    rows = len(channel.outliers)
    assert k * (N - rows) >= p + 3
