"""Exact derivatives of poses against differences of whole predictions, for every effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.pose_jacobian import pose_columns
from gapbridge.core.kernels.layout import LANES
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_vector

Array = NDArray[np.float64]
COUNT = LANES + 6  # a whole block, and one that is not
SHOWN = [name for name, effect in CATALOGUE.items() if "position" in effect.channels]


def deflected(effects: list[str], size: float = 3.0, seed: int = 0) -> Model:
    """Return an arm that bends and tilts, with these effects at some usual sizes everywhere."""
    rng = np.random.default_rng(seed)
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0.05, 0.02, 0.18)
    model = Model(builtin_arm("ur10e"), tool, 2.0, np.array([0.01, 0.02, 0.1]))
    model = model.with_compliance(rng.uniform(1e-6, 9e-6, 6), rng.uniform(1e-6, 4e-6, 6))
    model = model.with_terms([Term("base_compliance", Site(), (1e-6, 2e-6))])
    terms = []
    for name in effects:
        for site in CATALOGUE[name].sites(model.arm):
            own = replace(site, order=2.0) if name == "transmission_error" else site
            scales = [p.scale for p in CATALOGUE[name].parameters(model.arm, own)]
            values = size * np.array(scales) * rng.uniform(0.5, 1.0, len(scales))
            terms.append(Term(name, own, tuple(float(v) for v in values)))
    return model.with_terms(terms)


def situation(count: int, seed: int = 1) -> tuple[Array, Loads]:
    """Return joint angles (count, 6) and loads of every kind."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-2.5, 2.5, (count, 6)), Loads(
        payload_mass=rng.uniform(0, 6, count),
        payload_cog=rng.normal(0, 0.05, (count, 3)),
        wrench=rng.normal(0, 20, (count, 6)),
        temperature=rng.uniform(20, 45, (count, 6)),
        approach=np.sign(rng.normal(size=(count, 6))),
    )


def moved(model: Model, t: int, k: int, step: float) -> Model:
    term = model.terms[t]
    values = np.array(term.values)
    values[k] += step
    terms = (*model.terms[:t], term.with_values(values), *model.terms[t + 1 :])
    return replace(model, terms=terms)


def difference(model: Model, q: Array, loads: Loads, t: int, k: int, step: float) -> Array:
    """Return a column (6, N) by differences, the error of the step's square taken out."""
    found = []
    for h in (step, step / 2):
        one, other = (moved(model, t, k, way * h).predict(q, loads) for way in (1, -1))
        turn = rotation_vector(one.rotation @ np.swapaxes(other.rotation, 1, 2))
        found.append(np.hstack([one.position - other.position, turn]).T / (2 * h))
    return np.asarray((4 * found[1] - found[0]) / 3)


def every(model: Model, effects: list[str]) -> tuple[list[tuple[int, int]], Array]:
    """Return the places of all values of some effects, and their usual sizes."""
    places, scales = [], []
    for t, term in enumerate(model.terms):
        if term.effect in effects:
            for k, parameter in enumerate(CATALOGUE[term.effect].parameters(model.arm, term.site)):
                places.append((t, k))
                scales.append(parameter.scale)
    return places, np.array(scales)


@pytest.mark.parametrize("effect", SHOWN)
def test_columns_are_those_of_differences_on_an_arm_that_bends(effect):
    model, (q, loads) = deflected([effect]), situation(COUNT)
    places, scales = every(model, [effect])
    found = pose_columns(model, q, loads, places, 0.01 * scales)
    poses = model.predict(q, loads)
    assert np.abs(found.poses.position - poses.position).max() < 1e-12
    assert np.abs(found.poses.rotation - poses.rotation).max() < 1e-12
    for c, (t, k) in enumerate(places):
        expected = difference(model, q, loads, t, k, 0.05 * scales[c])
        off = np.abs(found.jacobian[:, c] - expected).max()
        # a moment has no slope at all: the step is where it is
        assert off <= 2e-7 * np.abs(expected).max(), (model.terms[t], k)


def test_columns_at_zero_are_those_of_the_rigid_arm():
    effects = ["joint_offset", "link_geometry", "tool_frame", "axial_compliance"]
    model = replace(deflected(effects, size=0.0), gravity=np.array([1.0, 2.0, -9.0]))
    model = replace(model, terms=tuple(t.with_values(0 * np.array(t.values)) for t in model.terms))
    q, loads = situation(5)
    places, scales = every(model, effects)
    found = pose_columns(model, q, loads, places, 0.01 * scales)
    for c, (t, k) in enumerate(places):
        expected = difference(model, q, loads, t, k, 0.05 * scales[c])
        off = np.abs(found.jacobian[:, c] - expected).max()
        assert off < 2e-7 * max(np.abs(expected).max(), 1e-9), (model.terms[t], k)


def test_where_a_link_bends_itself_every_column_is_a_difference():
    effects = ["link_flexibility", "joint_offset"]
    model, (q, loads) = deflected(effects), situation(4)
    places, scales = every(model, effects)
    found = pose_columns(model, q, loads, places, 0.01 * scales)
    for c, (t, k) in enumerate(places):
        expected = difference(model, q, loads, t, k, 0.01 * scales[c])
        assert np.abs(found.jacobian[:, c] - expected).max() < 1e-6 * np.abs(expected).max()


def test_a_row_has_the_columns_that_it_has_alone():
    model, (q, loads) = deflected(["joint_offset", "payload"]), situation(COUNT)
    places, scales = every(model, ["joint_offset", "payload", "axial_compliance"])
    whole = pose_columns(model, q, loads, places, scales).jacobian
    for r in (0, LANES, COUNT - 1):
        alone = pose_columns(model, q[r : r + 1], loads[r : r + 1], places, scales).jacobian
        scale = np.abs(whole).max(axis=(0, 2))[:, None]
        assert (np.abs(alone[..., 0] - whole[..., r]) / scale.T).max() < 1e-9


def test_a_load_under_which_the_arm_buckles_is_named():
    model, (q, loads) = deflected(["joint_offset"]), situation(4)
    soft = model.with_compliance([1e-1] * 6, [1e-1] * 6)
    with pytest.raises(InputError, match="row 1: the arm finds no equilibrium"):
        pose_columns(soft, q, loads, [(0, 0)], np.array([1e-5]))


def test_positions_alone_and_coarser_columns_are_the_same_within_what_was_asked():
    model, (q, loads) = deflected(["joint_offset", "payload"]), situation(COUNT)
    for effects in (["axial_compliance"], ["joint_offset", "tool_frame", "payload"]):
        places, scales = every(model, effects)
        whole = pose_columns(model, q, loads, places, scales)
        some = pose_columns(model, q, loads, places, scales, coordinates=3, converged=1e-7)
        assert some.jacobian.shape == (3, len(places), COUNT)
        scale = np.abs(whole.jacobian[:3]).max(axis=(0, 2))[:, None]
        assert (np.abs(some.jacobian - whole.jacobian[:3]) / scale).max() < 1e-6
        np.testing.assert_array_equal(some.poses.position, whole.poses.position)


def test_where_the_target_slips_once_rows_before_it_keep_their_poses():
    (site,) = CATALOGUE["target_slip"].sites(builtin_arm("ur10e"))
    model, (q, loads) = deflected(["joint_offset"]), situation(8)
    count = len(CATALOGUE["target_slip"].parameters(model.arm, site)) - 1
    model = model.with_terms([Term("target_slip", site, (*(2e-3,) * count, 4.5))])
    loads = replace(loads, time=np.arange(8.0))
    places, scales = every(model, ["joint_offset"])
    found = pose_columns(model, q, loads, places, 0.01 * scales)
    np.testing.assert_array_equal(found.poses.position, model.predict(q, loads).position)
    for c, (t, k) in enumerate(places):
        expected = difference(model, q, loads, t, k, 0.05 * scales[c])
        assert np.abs(found.jacobian[:, c] - expected).max() < 1e-6 * np.abs(expected).max()
