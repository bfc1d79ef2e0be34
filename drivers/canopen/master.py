"""The bus with our drives on it: NMT, SDO, SYNC and RPDOs by the canopen library, errors in words.

The library's heartbeat callbacks, SDO client and notifier thread are used as they are; its p402
setters are not, because each blocks for up to a second.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import canopen

from gapbridge.core.errors import LinkError
from gapbridge.drivers.can_bus.bus import close_bus, first_line, open_bus
from gapbridge.drivers.canopen.allowed import AllowedFrames
from gapbridge.drivers.canopen.listening import BusListener, Life
from gapbridge.drivers.canopen.objects import HEARTBEAT_BASE, SYNC, Address
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.sync_set import SyncCollector

ABSENT = (0x06020000, 0x06090011)  # SDO aborts: no such object, no such subindex
OPERATIONAL_STATE = 5


class _Network(canopen.Network):
    """The library's network; it sends what is allowed, and its thread ends soon when asked to."""

    NOTIFIER_CYCLE = 0.05
    NOTIFIER_SHUTDOWN_TIMEOUT = 1.0

    def __init__(self, bus: Any, allowed: AllowedFrames) -> None:
        super().__init__(bus)
        self._allowed = allowed

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a frame that the profile allows; all of the library's go this way."""
        self._allowed.check(can_id, data)
        super().send_message(can_id, data, remote)


class Master:
    """The only master of one profile's drives, on one bus."""

    def __init__(self, settings: CanopenSettings, profile: CanopenProfile) -> None:
        self._settings, self._profile = settings, profile
        self.collector = SyncCollector(profile)
        self.network: Any = None
        self.listener: BusListener | None = None
        self.life: Life | None = None
        self._beat_at = 0.0  # s, monotonic: when our next heartbeat is due

    @property
    def where(self) -> str:
        """Return how messages call the link."""
        return f"{self._settings.where()}: {self._profile.name}"

    def open(self) -> None:
        """Open the bus and listen; sends nothing. Raises LinkError."""
        bus = open_bus(self._settings)
        network: Any = _Network(bus, AllowedFrames(self._profile))
        self.listener = BusListener(network, self._profile, self.collector)
        network.listeners[:] = [self.listener]
        for node in self._profile.nodes:
            remote = network.add_node(node, self._profile.eds.dictionary(node))
            remote.sdo.RESPONSE_TIMEOUT = self._settings.sdo_timeout
        self.life = Life(network, self._profile)
        self._beat_at = 0.0
        network.connect()
        self.network = network

    def close(self) -> None:
        """Leave the bus; may be repeated."""
        network, self.network = self.network, None
        if network is None:
            return
        bus = network.bus
        with contextlib.suppress(Exception):  # disconnect raises what had ended the thread
            network.disconnect()
        close_bus(bus)

    def check(self) -> None:
        """Raise LinkError where the bus, or the thread that reads it, has gone."""
        if self.network is None:
            raise LinkError(f"{self.where}: found no bus, expected connect() first")
        try:
            self.network.check()
        except Exception as error:
            raise LinkError(f"{self.where}: {first_line(error)}") from None

    # -- frames -----------------------------------------------------------------------------------

    def send(self, cob_id: int, data: bytes, what: str) -> None:
        """Send one frame. Raises LinkError."""
        self.check()
        try:
            self.network.send_message(cob_id, data)
        except Exception as error:  # CanError, OSError, serial's
            raise LinkError(
                f"{self.where}: {what} could not be sent: {first_line(error)}"
            ) from None

    def sync(self) -> float:
        """Send one SYNC, and our heartbeat where it is due; returns when it left (s, monotonic)."""
        self.beat()
        now = time.monotonic()
        self.collector.begin(now)
        self.send(SYNC, b"", "SYNC")
        return now

    def beat(self) -> None:
        """Send our heartbeat where it is due. From the loop: it ends when the loop hangs."""
        now = time.monotonic()
        if now < self._beat_at:
            return
        self._beat_at = now + 0.5 * self._profile.heartbeat.ours
        ours = HEARTBEAT_BASE + self._profile.heartbeat.our_node
        self.send(ours, bytes([OPERATIONAL_STATE]), "heartbeat")

    def command(self, node: int, state: str) -> None:
        """Send an NMT command to one node: OPERATIONAL, PRE-OPERATIONAL. Raises LinkError."""
        self.check()
        try:
            self.network[node].nmt.state = state
        except Exception as error:
            raise LinkError(f"{self.where}: node {node}: {first_line(error)}") from None

    # -- objects ----------------------------------------------------------------------------------

    def sdo(self, node: int, what: str, act: Callable[[Any], Any]) -> Any:
        """Return what ``act`` does with a node of the library. Raises LinkError.

        ``what`` is named in messages.
        """
        self.check()
        try:
            return act(self.network[node])
        except canopen.SdoAbortedError as error:
            raise LinkError(
                f"{self.where}: node {node} refuses {what}: SDO abort 0x{error.code:08X}"
            ) from None
        except canopen.SdoCommunicationError:
            raise LinkError(f"{self.where}: node {node} does not answer ({what})") from None
        except Exception as error:  # an answer that no SDO server gives
            raise LinkError(f"{self.where}: node {node}: {what}: {first_line(error)}") from None

    def read(self, node: int, address: Address) -> int:
        """Return one object's value. Raises LinkError."""
        return int(self.sdo(node, str(address), lambda n: _variable(n, address).raw))

    def write(self, node: int, address: Address, value: int) -> None:
        """Write one object. Raises LinkError."""

        def act(remote: Any) -> None:
            _variable(remote, address).raw = value

        self.sdo(node, str(address), act)

    def read_where_present(self, node: int, address: Address) -> int | None:
        """Return an object's value, None where the EDS or the drive has none."""
        if not self._profile.eds.has(address):
            return None

        def act(remote: Any) -> int | None:
            try:
                return int(_variable(remote, address).raw)
            except canopen.SdoAbortedError as error:
                if error.code in ABSENT:
                    return None
                raise

        found: int | None = self.sdo(node, str(address), act)
        return found

    def write_where_present(self, node: int, address: Address, value: int) -> bool:
        """Write an object that a drive may lack; returns whether it has it. Raises LinkError."""
        if self.read_where_present(node, address) is None:
            return False
        self.write(node, address, value)
        return True


def _variable(remote: Any, address: Address) -> Any:
    found = remote.sdo[address.index]
    return found[address.subindex] if hasattr(found, "__getitem__") else found
