"""Blocks of lanes against core.kernels.reference and against plain numpy, to 1e-12."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.speed.peers import plain
from gapbridge.core.arm import builtin_arm
from gapbridge.core.kernels import many, threads
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.kernels.layout import LANES
from gapbridge.core.kernels.many import linear_blocks, predict_blocks
from gapbridge.core.kernels.reference import Chain, Rows
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

COUNT = 2 * LANES + 7  # whole blocks, and one that is not


def case(stiff: bool, count: int = COUNT, seed: int = 0) -> tuple[Chain, Rows]:
    rng = np.random.default_rng(seed)
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0.05, 0.02, 0.18)
    model = Model(builtin_arm("ur10e"), tool)
    loads = Loads(
        payload_mass=rng.uniform(0, 8, count),
        payload_cog=rng.normal(0, 0.1, (count, 3)),
        wrench=rng.normal(0, 20, (count, 6)),
    )
    chain, rows = model.chain(), model.rows(rng.uniform(-7, 7, (count, 6)), loads)
    rows.link_scale[:] = rng.uniform(0.999, 1.001, rows.link_scale.shape)
    if not stiff:
        chain.compliance[:] = rng.uniform(0, 3e-5, (6, 3))
        chain.softening[:] = rng.uniform(0, 1e-5, 6)
        chain.base_compliance[:] = rng.uniform(0, 1e-6, 3)
    return chain, rows


def forms(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros((count, 6, 12)), np.zeros((count, 6, 6)), np.zeros((count, 6, 3))


@pytest.mark.parametrize("stiff", [True, False])
def test_poses_and_linear_form_are_those_of_plain_numpy_and_of_the_single_row(stiff):
    chain, rows = case(stiff)
    position, rotation, found = np.zeros((COUNT, 3)), np.zeros((COUNT, 3, 3)), forms(COUNT)
    assert predict_blocks(chain, rows, 0, COUNT, position, rotation) == -1
    assert linear_blocks(chain, rows, 0, COUNT, *found) == -1
    expected = plain.solve(chain, rows)
    singly = forms(COUNT)
    kernel.regressor_rows(chain, rows, *singly)
    alone, turned = np.zeros((COUNT, 3)), np.zeros((COUNT, 3, 3))
    kernel.predict_rows(chain, rows, alone, turned)
    for one, other in ((position, expected.position), (rotation, expected.rotation),
                       (position, alone), (rotation, turned)):  # fmt: skip
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
    for one, other, single in zip(found, expected[2:], singly, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * np.abs(other).max())
        np.testing.assert_allclose(one, single, rtol=0, atol=1e-12 * np.abs(other).max())


def test_an_offset_into_the_rows_leaves_the_others_alone():
    chain, rows = case(stiff=False)
    position, rotation = np.full((COUNT, 3), 9.0), np.full((COUNT, 3, 3), 9.0)
    predict_blocks(chain, rows, 5, 80, position, rotation)
    assert (position[:5] == 9.0).all()
    assert (position[80:] == 9.0).all()
    assert (position[5:80] != 9.0).all()


def test_a_row_without_equilibrium_is_named_and_spoils_no_other():
    chain, rows = case(stiff=False)
    rows.wrench[70] = 1e7
    rows.q[90, 2] = np.nan
    position, rotation = np.zeros((COUNT, 3)), np.zeros((COUNT, 3, 3))
    assert predict_blocks(chain, rows, 0, COUNT, position, rotation) == 70
    good = np.delete(np.arange(COUNT), [70, 90])
    np.testing.assert_allclose(
        position[good], plain.solve(chain, Rows(*(part[good] for part in rows))).position,
        rtol=0, atol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize("width", [3, 6])
def test_the_factor_without_stored_rows_is_that_of_the_stored_ones(width):
    chain, rows = case(stiff=False)
    rng = np.random.default_rng(1)
    gap, cells = rng.normal(0, 1e-3, (COUNT, width)), rng.uniform(0.1, 3, (COUNT, width))
    R = np.zeros((13, 13))
    assert factor_blocks(chain, rows, gap, cells, 0, COUNT, R) == -1
    A = plain.solve(chain, rows).regressor[:, :width]
    stored = np.concatenate([A, gap[..., None]], axis=2) * cells[..., None]
    stored = stored.reshape(-1, 13)
    right = np.linalg.qr(stored, mode="r")
    scale = np.abs(right).max(axis=0)
    np.testing.assert_allclose(np.abs(R) / scale, np.abs(right) / scale, rtol=0, atol=1e-11)
    found = np.linalg.solve(R[:12, :12], R[:12, 12])
    expected = np.linalg.lstsq(stored[:, :12], stored[:, 12], rcond=None)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_threads_and_rows_that_do_not_settle_change_nothing(monkeypatch):
    chain, rows = case(stiff=False, count=6 * LANES + 3)
    rows.wrench[100, 0] = 3e5  # bends too far for the blocks, not for the single row
    expected, singly = forms(len(rows.q)), forms(len(rows.q))
    kernel.regressor_rows(chain, rows, *expected)
    monkeypatch.setattr(threads, "FEWEST", LANES)
    monkeypatch.setattr(threads, "processors", lambda: 3)
    many.linear_form(chain, rows, *singly)
    for one, other in zip(singly, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(other).max())


def test_what_goes_wrong_in_a_thread_is_reported(monkeypatch):
    monkeypatch.setattr(threads, "FEWEST", LANES)
    monkeypatch.setattr(threads, "processors", lambda: 2)

    def work(first: int, last: int) -> int:
        if first:
            raise ValueError(f"{first} to {last}")
        return first

    with pytest.raises(ValueError, match="128 to 256"):
        threads.in_ranges(work, 4 * LANES)
