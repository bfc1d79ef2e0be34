"""How files are shared out over the processes of xdist."""

from __future__ import annotations

from typing import Any

from waiting import WAITING, waits
from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

ONE_BY_ONE = "tests/benchmarks/test_simulated_runs.py::test_what_must_hold"
"""Cases that take as long as other files, and have nothing in common that is made for them."""


class Scheduling(LoadFileScheduling):  # type: ignore[misc]
    """Files that wait go to ``WAITING``, which take others last; the rest never take them.

    Files are shared out whole, those with many cases first; ``ONE_BY_ONE`` come last, and no
    process has much left when the others are done.
    """

    def _split_scope(self, nodeid: str) -> str:
        return nodeid if nodeid.startswith(ONE_BY_ONE) else str(super()._split_scope(nodeid))

    def _assign_work_unit(self, node: Any) -> None:
        waiting = node.gateway.id in WAITING
        fit = [file for file in self.workqueue if waits(file) == waiting]
        if fit:
            self.workqueue.move_to_end(fit[0], last=False)
        super()._assign_work_unit(node)

    def _reschedule(self, node: Any) -> None:
        if node.gateway.id in WAITING or not all(map(waits, self.workqueue)):
            super()._reschedule(node)
        elif not node.shutting_down:
            node.shutdown()
