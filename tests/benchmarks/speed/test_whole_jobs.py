"""The jobs that other libraries do beside our commands are the same jobs."""

from __future__ import annotations

import numpy as np
import pyarrow
import pytest

from benchmarks.speed.command_peers import CHAIN
from benchmarks.speed.peers import whole_jobs
from gapbridge.core.arm import builtin_arm
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


@pytest.mark.parametrize("mechanics", [whole_jobs.by_pinocchio, whole_jobs.by_mujoco])
def test_other_libraries_have_our_columns_under_every_payload(mechanics):
    tool = np.eye(4)
    tool[:3, 3] = (0.04, -0.03, 0.15)
    model, rng = Model(builtin_arm("ur10e"), tool), np.random.default_rng(3)
    q, mass = rng.uniform(-2, 2, (60, 6)), rng.choice([0.0, 3.0, 6.0], 60)
    cog = np.tile([0.0, 0.02, 0.1], (60, 1))
    names = [f"actual_q_{i}" for i in range(6)] + [f"payload_cog_{i}" for i in range(3)]
    log = pyarrow.table([*q.T, *cog.T, mass], [*names, "payload"])
    chain = model.chain()
    arm = {name: getattr(chain, name) for name in CHAIN}
    statics = whole_jobs.statics_of(mechanics, arm, log)
    tcp, turn, columns, jacobian = whole_jobs.columns(arm, *statics)
    form, poses = model.linear_form(q, Loads(mass, cog)), model.rigid_pose(q)
    np.testing.assert_allclose(tcp, poses.position, atol=1e-12)
    np.testing.assert_allclose(turn, poses.rotation, atol=1e-12)
    np.testing.assert_allclose(jacobian, form.jacobian, atol=1e-12)
    np.testing.assert_allclose(columns, form.regressor, atol=1e-6)  # up to 300; weightless bodies
