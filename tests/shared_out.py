"""How whole files are shared out over the processes of xdist."""

from __future__ import annotations

from typing import Any

from waiting import WAITING, waits
from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]


class Scheduling(LoadFileScheduling):  # type: ignore[misc]
    """Files that wait go to ``WAITING``, which take others last; the rest never take them."""

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
