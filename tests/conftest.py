"""How the tests are shared out over two processes, and which get more chances than one."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent
REAL_TIME = ("bridge", "drivers", "faults", "hil")
CHANCES = 3  # more, of a test in real time
TOGETHER = ("drivers/can", "drivers/canopen")  # their buses are served on the same addresses


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep a file's tests in one process; real time may have stood still on a busy machine.

    Such a machine stands still more than once in the minutes of a run. A test that needed another
    chance is listed at the end.
    """
    for item in items:
        place = item.path.relative_to(HERE).as_posix()
        group = next((name for name in TOGETHER if place.startswith(f"{name}/")), place)
        item.add_marker(pytest.mark.xdist_group(group))
        if place.split("/")[0] in REAL_TIME:
            item.add_marker(pytest.mark.flaky(reruns=CHANCES))
