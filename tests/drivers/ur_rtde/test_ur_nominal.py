"""The robot's own joints, out of target joints that hold an offset."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import InvalidStateError
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector
from gapbridge.drivers.offset_inverse import Nominal

REGULAR = np.array([0.1, -1.2, 1.3, -0.5, 1.5, 0.2])  # elbow bent, wrist far from singular
MODEL = Model(builtin_arm("ur10e"))


@given(
    st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6),
    st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
    st.sampled_from([1e-12, 1e-8, 1e-4, 5e-3]),
)
@settings(max_examples=200, deadline=None)
def test_the_tcp_at_the_nominal_joints_moved_by_the_offset_is_that_of_the_target(
    turned: list[float], direction: list[float], size: float
) -> None:
    target, offset = REGULAR + np.array(turned), size * np.array(direction)
    nominal = Nominal(MODEL).without(target, offset)
    wanted, found = MODEL.rigid_pose(target[None]), MODEL.rigid_pose(nominal[None])
    np.testing.assert_allclose(found.position[0] + offset[:3], wanted.position[0], atol=2e-10)
    moved = rotation_matrix(offset[3:]) @ found.rotation[0]
    np.testing.assert_allclose(rotation_vector(moved @ wanted.rotation[0].T), 0.0, atol=4e-10)


def test_a_sample_gives_the_same_whatever_the_one_before_was() -> None:
    offset = np.array([1e-3, 2e-4, -4e-4, 1e-4, 2e-4, 3e-4])
    warm, cold = Nominal(MODEL), Nominal(MODEL)
    warm.without(REGULAR - 0.01, 0.5 * offset)
    np.testing.assert_allclose(
        warm.without(REGULAR, offset), cold.without(REGULAR, offset), rtol=0.0, atol=1e-9
    )


def test_an_offset_of_zero_changes_no_bit() -> None:
    nominal = Nominal(MODEL)
    nominal.without(REGULAR, np.full(6, 1e-4))
    assert nominal.without(REGULAR, np.zeros(6)).tobytes() == REGULAR.tobytes()


def test_an_offset_that_no_joints_make_is_refused() -> None:
    with pytest.raises(InvalidStateError, match="target_q: found no joints"):
        Nominal(MODEL).without(REGULAR, np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
