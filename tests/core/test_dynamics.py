"""Rigid dynamics against Pinocchio, at random arms, motions, payloads and pulls."""

from __future__ import annotations

import moving_truth as truth
import numpy as np
import pinocchio as pin
import pytest

from gapbridge.core.dynamics import OWN_SHIFT, predict_torque, predict_wrench
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.motion import Motion


def motion_at(q, qd, qdd, loads):
    count, n = q.shape
    return Motion(
        t=np.zeros(count), q=q, qd=qd, qdd=qdd, target_q=None, loads=loads, rows=np.arange(count),
        valid=np.ones(count, dtype=bool), stretch=np.zeros(count, dtype=int), start=0.0,
        moving=True, still=np.full(n, 1e-3),
    )  # fmt: skip


@pytest.fixture(params=[6, 7])
def case(request, tmp_path):
    rng = np.random.default_rng(request.param)
    plant = truth.plant(tmp_path, request.param, seed=request.param)
    q, qd, qdd = (rng.uniform(-s, s, (40, request.param)) for s in (3, 2, 5))
    return plant, q, qd, qdd, rng.uniform(-30, 30, (40, 6)), rng.uniform(0, 10, 40)


def test_torques_and_wrenches_are_those_of_pinocchio(case):
    plant, q, qd, qdd, pull, mass = case
    torque, wrench = plant.dynamics(q, qd, qdd, pull, mass)
    motion = motion_at(q, qd, qdd, Loads(payload_mass=mass, wrench=pull))
    model = plant.model()
    assert np.abs(predict_torque(model, motion) - torque).max() < 1e-9
    assert np.abs(predict_wrench(model, motion) - wrench).max() < 1e-9


def test_a_mass_at_rest_reads_its_weight_pointing_down(case):
    plant, q, *_ = case
    zero = np.zeros_like(q)
    model = plant.model(payload=3.0)
    wrench = predict_wrench(model, motion_at(q, zero, zero, Loads()))
    up = model.rigid_pose(q).rotation
    in_base = np.einsum("rij,rj->ri", up, wrench[:, :3])
    assert np.allclose(in_base, [0, 0, -3 * 9.80665], atol=1e-9)
    assert np.allclose(wrench[:, 3:], np.cross(truth.COG, wrench[:, :3]), atol=1e-9)


def test_a_pull_at_the_tcp_reads_as_it_is_and_eases_the_motors(case):
    plant, q, *_ = case
    zero = np.zeros_like(q)
    up = np.tile([0, 0, 20.0, 0, 0, 0], (len(q), 1))
    model = plant.model(payload=20 / 9.80665)
    held = motion_at(q, zero, zero, Loads(wrench=up))
    free = motion_at(q, zero, zero, Loads())
    in_base = np.einsum(
        "rij,rj->ri", model.rigid_pose(q).rotation, predict_wrench(model, held)[:, :3]
    )
    assert np.abs(in_base).max() < 1e-9
    # the pull at the TCP and the weight at the cog differ by their couple only
    bare = predict_torque(plant.model(), free)
    saved = np.abs(predict_torque(model, held) - bare).mean()
    assert saved < 0.5 * np.abs(predict_torque(model, free) - bare).mean()


def shifted_link(plant, monkeypatch, link, shift):
    """Have Pinocchio's link (from 1) with its centre of gravity moved by (3,) m, link axes."""
    nominal = type(plant).pinocchio

    def moved(self, *arguments, **more):
        model = nominal(self, *arguments, **more)
        old = model.inertias[link]
        model.inertias[link] = pin.Inertia(old.mass, old.lever + shift, old.inertia)
        return model

    monkeypatch.setattr(type(plant), "pinocchio", moved)


def first_moment(plant, link, shift):
    return Term("link_cog", Site(link), tuple(plant.arm.mass[link - 1] * shift))


@pytest.mark.parametrize("link", [2, 5])
def test_a_links_mass_that_lies_elsewhere_takes_the_torques_of_pinocchio(case, link, monkeypatch):
    plant, q, qd, qdd, *_ = case
    shift = 0.99 * OWN_SHIFT * np.array([2, -1, 2]) / 3
    shifted_link(plant, monkeypatch, link, shift)
    motion = motion_at(q, qd, qdd, Loads())
    found = predict_torque(plant.model(), motion, [first_moment(plant, link, shift)])
    assert np.abs(found - plant.dynamics(q, qd, qdd)[0]).max() < 1e-9


def test_a_counterweight_takes_its_weight_and_no_more_inertia_than_the_links_own_mass(
    case, monkeypatch
):
    plant, q, qd, qdd, *_ = case
    shift, zero, model = np.array([-1.2, 0.3, 0.4]), np.zeros_like(q), plant.model()
    at_rest, moving = motion_at(q, zero, zero, Loads()), motion_at(q, qd, qdd, Loads())
    once, twice, thrice = (
        predict_torque(model, moving, [first_moment(plant, 2, times * shift)])
        for times in (1, 2, 3)
    )
    assert np.abs((thrice - twice) - (twice - once)).max() < 1e-9
    shifted_link(plant, monkeypatch, 2, shift)
    held = predict_torque(model, at_rest, [first_moment(plant, 2, shift)])
    assert np.abs(held - plant.dynamics(q, zero, zero)[0]).max() < 1e-9
