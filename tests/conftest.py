"""How the tests are shared out over two processes, and which get a second chance."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent
REAL_TIME = ("bridge", "drivers", "faults", "hil")
TOGETHER = ("drivers/can", "drivers/canopen")  # their buses are served on the same addresses


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep a file's tests in one process; real time may have stood still on a busy machine.

    A test that needed its second chance is listed at the end of the run.
    """
    for item in items:
        place = item.path.relative_to(HERE).as_posix()
        group = next((name for name in TOGETHER if place.startswith(f"{name}/")), place)
        item.add_marker(pytest.mark.xdist_group(group))
        if place.split("/")[0] in REAL_TIME:
            item.add_marker(pytest.mark.flaky(reruns=1))
