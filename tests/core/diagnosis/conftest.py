"""Small matrices, many of them: more than one thread for each only costs time on a busy machine."""

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(scope="package", autouse=True)
def one_thread_for_linear_algebra():
    with threadpool_limits(1):
        yield
