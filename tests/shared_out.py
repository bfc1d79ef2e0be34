"""How whole files are shared out over the processes of xdist."""

from __future__ import annotations

from typing import Any

from realtime import WAITING, is_realtime
from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]


class Scheduling(LoadFileScheduling):  # type: ignore[misc]
    """Files in real time go to ``WAITING``, which take others last; the rest never take them."""

    def _assign_work_unit(self, node: Any) -> None:
        waits = node.gateway.id in WAITING
        fit = [file for file in self.workqueue if is_realtime(file) == waits]
        if fit:
            self.workqueue.move_to_end(fit[0], last=False)
        super()._assign_work_unit(node)

    def _reschedule(self, node: Any) -> None:
        if node.gateway.id in WAITING or not all(map(is_realtime, self.workqueue)):
            super()._reschedule(node)
        elif not node.shutting_down:
            node.shutdown()
