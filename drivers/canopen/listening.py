"""Listening on the bus: TPDOs, heartbeats, emergencies, and commands of another master."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from canopen.network import MessageListener, Network

from gapbridge.drivers.can_bus.bus import is_own
from gapbridge.drivers.canopen.objects import (
    HEARTBEAT_BASE,
    NMT,
    PDO_COUNT,
    PDO_STEP,
    RPDO_BASE,
    SDO_REQUEST_BASE,
    SYNC,
)
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.sync_set import SyncCollector
from gapbridge.drivers.clock import Clock

KEPT = 64  # emergencies stored
PAUSE = 0.02  # s between two readings of a lost bus
OPERATIONAL = 5  # NMT state


@dataclass(frozen=True, slots=True)
class ForeignCommand:
    """A frame that only a master sends, and that we did not send."""

    what: str
    seen: float  # s, monotonic


@dataclass(frozen=True, slots=True)
class Emergency:
    """One EMCY of a drive."""

    node: int
    code: int

    def __str__(self) -> str:
        return f"node {self.node}: EMCY 0x{self.code:04X}"


class BusListener(MessageListener):
    """Passes frames to the collector and the canopen library; our own are not received."""

    def __init__(
        self,
        network: Network,
        settings: CanopenSettings,
        profile: CanopenProfile,
        collector: SyncCollector,
        clock: Clock,
    ) -> None:
        super().__init__(network)
        self._settings = settings
        self._clock = clock
        self._collector = collector
        self._commands = _commands(profile)
        self.foreign: ForeignCommand | None = None
        self.error_frames = 0

    def on_message_received(self, msg: Any) -> None:
        """Take one frame, from the notifier's thread."""
        if msg.is_error_frame:
            self.error_frames += 1
            return
        if msg.is_remote_frame or msg.is_extended_id or msg.is_fd:
            return
        if is_own(msg, self._settings):
            return
        now, cob_id = self._clock.monotonic(), int(msg.arbitration_id)
        what = self._commands.get(cob_id)
        if what is not None:
            self.foreign = ForeignCommand(what, now)
            return
        self._collector.take(cob_id, bytes(msg.data), now)
        super().on_message_received(msg)  # type: ignore[no-untyped-call]

    def on_error(self, exc: Exception) -> None:
        """Suppress the notifier thread's traceback; ``Network.check`` reports the error.

        The thread runs until it is stopped, so it must pause.
        """
        self._clock.sleep(PAUSE)


def _commands(profile: CanopenProfile) -> dict[int, str]:
    """Return the identifiers that a master of our drives uses, and their names for messages."""
    names = {SYNC: "SYNC", NMT: "NMT command"}
    names[HEARTBEAT_BASE + profile.heartbeat.our_node] = "heartbeat with our node id"
    for node in profile.nodes:
        names[SDO_REQUEST_BASE + node] = f"SDO request to node {node}"
        for number in range(PDO_COUNT):
            names[RPDO_BASE + PDO_STEP * number + node] = f"RPDO{number + 1} of node {node}"
    return names


class HeartbeatMonitor:
    """The last heartbeat, NMT state and emergencies of each drive."""

    def __init__(self, network: Network, profile: CanopenProfile, clock: Clock) -> None:
        self._profile, self._now = profile, clock.monotonic
        self.received_at: dict[int, float] = {}  # node -> s, monotonic
        self.nmt: dict[int, int] = {}  # node -> NMT state that it reported last
        self.restarted: set[int] = set()
        self.active: dict[int, Emergency] = {}
        self.log: deque[Emergency] = deque(maxlen=KEPT)
        for node in profile.nodes:
            remote: Any = network[node]
            remote.nmt.add_heartbeat_callback(self._heartbeat_of(node))
            remote.emcy.add_callback(self._emergency_of(node, remote.emcy))

    def _heartbeat_of(self, node: int) -> Any:
        def note(state: int) -> None:
            self.received_at[node] = self._now()
            if state == 0:
                self.restarted.add(node)
            self.nmt[node] = state

        return note

    def _emergency_of(self, node: int, consumer: Any) -> Any:
        def note(error: Any) -> None:
            emergency = Emergency(node, error.code)
            self.log.append(emergency)
            if error.code & 0xFF00:
                self.active[node] = emergency
            else:
                self.active.pop(node, None)
            if len(consumer.log) > KEPT:  # the library's own log has no end
                consumer.reset()

        return note

    def started(self) -> None:
        """Reset states and restarts: the drives have just been configured."""
        self.restarted.clear()
        self.nmt.clear()
        now = self._now()
        self.received_at = dict.fromkeys(self._profile.nodes, now)

    @property
    def all_operational(self) -> bool:
        """Return whether every node's heartbeat has reported that it is OPERATIONAL."""
        return all(self.nmt.get(node) == OPERATIONAL for node in self._profile.nodes)

    def lost(self) -> int | None:
        """Return a node whose heartbeats have ceased; None: none."""
        now = self._now()
        for node in self._profile.nodes:
            if now - self.received_at.get(node, 0.0) > self._profile.heartbeat.lost_after:
                return node
        return None

    def not_operational(self) -> int | None:
        """Return a node that has restarted or left NMT's OPERATIONAL; None: none."""
        for node in self._profile.nodes:
            if node in self.restarted or self.nmt.get(node, OPERATIONAL) != OPERATIONAL:
                return node
        return None
