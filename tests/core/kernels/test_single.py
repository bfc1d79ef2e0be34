"""The correction in one call against the one that reference.py solves step by step, to 1e-12."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import Compensator
from gapbridge.core.effects import Site, Term
from gapbridge.core.kernels import single
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


def deflected() -> Model:
    rng = np.random.default_rng(4)
    tool = np.eye(4)
    tool[:3, 3] = (0.03, 0.01, 0.2)
    model = Model(builtin_arm("ur10e"), tool, 6.0, np.array([0.0, 0.03, 0.1]))
    model = model.with_compliance(rng.uniform(1e-6, 2e-5, 6), rng.uniform(1e-6, 1e-5, 6))
    return model.with_terms(
        [
            Term("base_compliance", Site(), (2e-6, 1e-6)),
            Term("joint_offset", Site(3), (1e-3,)),
            Term("stiffness_nonlinearity", Site(2), (4e-6, 1e-5)),
        ]
    )


def path(count: int = 60) -> np.ndarray:
    q = np.array([0.3, -1.2, 1.5, -1.8, -1.5, 0.2])
    return q + 0.4 * np.sin(np.linspace(0, 5, count)[:, None] * np.arange(1, 7))


def test_each_correction_along_a_path_is_that_of_the_general_way():
    one, other = Compensator(deflected()), Compensator(deflected())
    other._plain = False
    rng = np.random.default_rng(0)
    for q in path():
        loads = Loads(wrench=rng.normal(0, 30, (1, 6)))
        quick, general = one.correct(q, loads), other.correct(q, loads)
        np.testing.assert_allclose(quick.q, general.q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(quick.offset_in_base, general.offset_in_base, rtol=0, atol=1e-12)
        assert quick.steps == general.steps


@pytest.mark.parametrize(
    "q", [np.zeros(6), np.array([0.0, -1.5, 0.0, -1.5, 0.0, 0.0]), np.full(6, np.nan)]
)
def test_singular_poses_and_no_numbers_go_the_same_way(q):
    one, other = Compensator(deflected()), Compensator(deflected())
    other._plain = False
    quick, general = one.correct(q), other.correct(q)
    np.testing.assert_allclose(quick.q, general.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(quick.residual, general.residual, rtol=1e-6, atol=1e-9)


def test_a_load_under_which_the_arm_buckles_is_reported_and_forgotten():
    one = Compensator(deflected())
    assert one.correct(path()[0], Loads(wrench=np.full((1, 6), 1e9))).residual == np.inf
    after = one.correct(path()[0], Loads())
    np.testing.assert_allclose(after.q, Compensator(deflected()).correct(path()[0]).q, atol=1e-12)


def test_a_correction_leaves_nothing_behind_in_memory():
    live, found, poses = Compensator(deflected()), np.empty(12), path(400)
    live.correct(poses[0])

    def run() -> None:
        for q in poses:
            single.correct(live._block, q, live._mass, live._cog, live._wrench, found)

    run()
    tracemalloc.start()
    run()
    before, _ = tracemalloc.get_traced_memory()
    run()
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 1000
