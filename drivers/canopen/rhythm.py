"""The beat of SYNCs: one a period, none in bursts, some left out after a torn set."""

from __future__ import annotations

import time

from gapbridge.drivers.canopen.command import RpdoWriter
from gapbridge.drivers.canopen.master import Master
from gapbridge.drivers.canopen.sync_set import SyncSet

MOST_LEFT_OUT = 3  # SYNCs after a torn set


class Rhythm:
    """Sends SYNCs at absolute deadlines and takes what answers them."""

    def __init__(self, master: Master, writer: RpdoWriter, period: float, window: float) -> None:
        self._master, self._writer = master, writer
        self._period, self._window = period, window  # s
        self._due = 0.0  # s, monotonic: of the next SYNC
        self._torn = False  # the last set was not whole
        self.sample: SyncSet | None = None  # the last that was whole

    def exchange(self) -> SyncSet | None:
        """Send one SYNC when it is due and return its TPDOs, None where they are torn.

        Raises LinkError where the bus has gone, or where a part of a setpoint stands in the drives.
        """
        if self._torn:
            self._let_late_ones_come()
        self._wait_for_slot()
        self._writer.make_whole()
        collector = self._master.collector
        collector.forget_stray()
        found = collector.wait(self._master.sync() + self._window)
        self._torn = found is None
        if found is not None:
            self.sample = found
        return found

    def _wait_for_slot(self) -> None:
        now = time.monotonic()
        self._due += self._period
        if self._due < now - 0.5 * self._period:
            self._due = now  # too late for the slot: no burst
        if self._due > now:
            time.sleep(self._due - now)

    def _let_late_ones_come(self) -> None:
        """Leave SYNCs out after a torn set: one, and up to three while TPDOs are missing.

        Else what comes late would be taken for the next SYNC's.
        """
        for _ in range(MOST_LEFT_OUT):
            self._wait_for_slot()
            self._master.beat()
            if not self._master.collector.owed:
                return
