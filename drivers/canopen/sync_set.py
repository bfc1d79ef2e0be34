"""The TPDOs of one SYNC: valid only if all were received, once each, after that SYNC."""

from __future__ import annotations

import threading
from collections import Counter
from enum import StrEnum
from typing import NamedTuple

from gapbridge.drivers.canopen.pdo import PdoLayout
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.clock import Clock


class DropReason(StrEnum):
    """Why a frame or a set was dropped."""

    TWICE = "twice"
    MALFORMED = "malformed"
    LATE = "late"
    NO_SYNC = "no SYNC"
    TORN = "torn"


class SyncSet(NamedTuple):
    """The reports of all drives at one SYNC. A tuple, because one is created in every cycle."""

    counts: tuple[dict[str, int], ...]  # per joint: object name -> counts
    synced: float  # s, monotonic, when the SYNC was sent
    received: float  # s, monotonic, of the last TPDO


class SyncCollector:
    """Collects the TPDOs of one SYNC at a time. One thread may feed it while another waits."""

    def __init__(self, profile: CanopenProfile, clock: Clock) -> None:
        self._clock = clock
        self._members: dict[int, tuple[int, PdoLayout]] = {
            layout.cob_id(node): (joint, layout)
            for joint, node in enumerate(profile.nodes)
            for layout in profile.tpdo
        }
        self._nodes = profile.nodes
        self._lock = threading.Lock()
        self._over = threading.Event()  # the set is whole, or rejected
        self._frames: dict[int, dict[str, int]] = {}
        self._open = False
        self._rejected: tuple[DropReason, str, str] | None = None  # why, which TPDO, detail
        self._synced = self._received = 0.0
        self._missing: set[int] = set()  # COB-IDs that a torn set lacked and that may still arrive
        self.dropped: Counter[DropReason] = Counter()  # reason -> frames or sets
        self.stray = ""  # a TPDO without a SYNC since ``clear_stray``; empty: none

    def clear_stray(self) -> None:
        """Reset ``stray``: it was evaluated."""
        self.stray = ""

    def begin(self, now: float) -> None:
        """Start a new set: a SYNC leaves at ``now`` (s, monotonic)."""
        with self._lock:
            self._frames, self._rejected, self._open = {}, None, True
            self._missing.clear()
            self._over.clear()
            self._synced = self._received = now

    def take(self, cob_id: int, data: bytes, now: float) -> None:
        """Add one frame. Raises nothing; ignores frames that are no TPDO of the profile."""
        member = self._members.get(cob_id)
        if member is None:
            return
        joint, layout = member
        who = f"{layout.name} of node {self._nodes[joint]}"
        with self._lock:
            if not self._open:
                self._take_late(cob_id, who)
                return
            if cob_id in self._frames:
                self._reject(DropReason.TWICE, who)
                return
            try:
                self._frames[cob_id] = layout.decode(data)
            except ValueError as error:
                self._reject(DropReason.MALFORMED, who, str(error))
                return
            self._received = now
            if len(self._frames) == len(self._members):
                self._open = False
                self._over.set()

    def _take_late(self, cob_id: int, who: str) -> None:
        if cob_id in self._missing:
            self._missing.discard(cob_id)
            self.dropped[DropReason.LATE] += 1
        else:
            self.dropped[DropReason.NO_SYNC] += 1
            self.stray = who

    @property
    def awaits_late(self) -> bool:
        """Return whether TPDOs of a torn set may still arrive, which would mix with the next."""
        return bool(self._missing)

    def _reject(self, reason: DropReason, who: str, detail: str = "") -> None:
        self.dropped[reason] += 1
        self._rejected = self._rejected or (reason, who, detail)
        self._over.set()

    def wait(self, until: float) -> SyncSet | None:
        """Return the set, None where it is incomplete or rejected by ``until``."""
        self._clock.wait(self._over, max(until - self._clock.monotonic(), 0.0))
        with self._lock:
            self._open = False
            if self._rejected or len(self._frames) < len(self._members):
                self.dropped[DropReason.TORN] += 1
                self._missing = set(self._members) - set(self._frames)
                return None
            counts: list[dict[str, int]] = [{} for _ in self._nodes]
            for cob_id, objects in self._frames.items():
                counts[self._members[cob_id][0]].update(objects)
            return SyncSet(tuple(counts), self._synced, self._received)

    @property
    def empty(self) -> bool:
        """Return whether nothing was received since the SYNC."""
        return not self._frames and not self._rejected

    def why(self) -> str:
        """Return why this set is invalid."""
        if self._rejected:
            reason, who, detail = self._rejected
            twice = reason == DropReason.TWICE
            return f"{who} came twice after one SYNC" if twice else f"{who}: {detail}"
        missing = [
            f"{layout.name} of node {self._nodes[joint]}"
            for cob_id, (joint, layout) in self._members.items()
            if cob_id not in self._frames
        ]
        few = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        return f"found {len(self._frames)} of {len(self._members)} TPDOs, without {few}"
