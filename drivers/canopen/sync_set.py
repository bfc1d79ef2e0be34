"""One SYNC's TPDOs: they count only when all have come, each once, none from the SYNC before."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import NamedTuple

from gapbridge.drivers.canopen.pdo import PdoLayout
from gapbridge.drivers.canopen.profile import CanopenProfile


class SyncSet(NamedTuple):
    """What all drives reported at one SYNC. A tuple, because one is made in every cycle."""

    counts: tuple[dict[str, int], ...]  # per joint: object name -> counts
    synced: float  # s, time.monotonic() when the SYNC left
    received: float  # s, time.monotonic() of the last TPDO


class SyncCollector:
    """Collects the TPDOs of one SYNC at a time. One thread may feed it while another waits."""

    def __init__(self, profile: CanopenProfile) -> None:
        self._members: dict[int, tuple[int, PdoLayout]] = {
            layout.cob_id(node): (joint, layout)
            for joint, node in enumerate(profile.nodes)
            for layout in profile.tpdo
        }
        self._nodes = profile.nodes
        self._changed = threading.Condition()
        self._held: dict[int, dict[str, int]] = {}
        self._open = False
        self._rejected = ""  # why this set cannot be believed
        self._synced = self._received = 0.0
        self._missing: set[int] = set()  # COB-IDs that a torn set lacked, and that may still come
        self.dropped: Counter[str] = Counter()  # reason -> frames or sets
        self.stray = ""  # a TPDO that came to no SYNC since the last look; empty: none

    def clear_stray(self) -> None:
        """Take note that somebody has looked at ``stray``."""
        self.stray = ""

    def begin(self, now: float) -> None:
        """Forget what was collected: a SYNC leaves at ``now`` (s, monotonic)."""
        with self._changed:
            self._held, self._rejected, self._open = {}, "", True
            self._missing.clear()
            self._synced = self._received = now

    def end(self) -> None:
        """Take nothing until the next SYNC."""
        with self._changed:
            self._open = False

    def take(self, cob_id: int, data: bytes, now: float) -> None:
        """Take one frame. Raises nothing; what is no TPDO of the profile is passed over."""
        member = self._members.get(cob_id)
        if member is None:
            return
        joint, layout = member
        who = f"{layout.name} of node {self._nodes[joint]}"
        with self._changed:
            if not self._open:
                self._take_late(cob_id, who)
                return
            if cob_id in self._held:
                self._refuse("twice", f"{who} came twice after one SYNC")
                return
            try:
                self._held[cob_id] = layout.decode(data)
            except ValueError as error:
                self._refuse("malformed", f"{who}: {error}")
                return
            self._received = now
            if len(self._held) == len(self._members):
                self._open = False
                self._changed.notify_all()

    def _take_late(self, cob_id: int, who: str) -> None:
        if cob_id in self._missing:
            self._missing.discard(cob_id)
            self.dropped["late"] += 1
        else:
            self.dropped["no SYNC"] += 1
            self.stray = who

    @property
    def awaits_late(self) -> bool:
        """Return whether TPDOs of a torn set may still come: they must not meet the next SYNC's."""
        return bool(self._missing)

    def _refuse(self, reason: str, message: str) -> None:
        self.dropped[reason] += 1
        self._rejected = self._rejected or message
        self._changed.notify_all()

    def wait(self, until: float) -> SyncSet | None:
        """Return the set, None where it is not whole or cannot be believed by ``until``."""
        with self._changed:
            self._changed.wait_for(self._over, max(until - time.monotonic(), 0.0))
            self._open = False
            if self._rejected or len(self._held) < len(self._members):
                self.dropped["torn"] += 1
                self._missing = set(self._members) - set(self._held)
                return None
            counts: list[dict[str, int]] = [{} for _ in self._nodes]
            for cob_id, found in self._held.items():
                counts[self._members[cob_id][0]].update(found)
            return SyncSet(tuple(counts), self._synced, self._received)

    def _over(self) -> bool:
        return bool(self._rejected) or len(self._held) == len(self._members)

    @property
    def empty(self) -> bool:
        """Return whether nothing at all has come since the SYNC."""
        return not self._held and not self._rejected

    def why(self) -> str:
        """Return what is wrong with the set at hand."""
        if self._rejected:
            return self._rejected
        missing = [
            f"{layout.name} of node {self._nodes[joint]}"
            for cob_id, (joint, layout) in self._members.items()
            if cob_id not in self._held
        ]
        few = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        return f"found {len(self._held)} of {len(self._members)} TPDOs, without {few}"
