"""Enabling and disabling the drives by their CiA 402 state machines, SYNC by SYNC."""

from __future__ import annotations

from collections.abc import Callable

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, WriteError
from gapbridge.drivers.canopen.command import RpdoWriter
from gapbridge.drivers.canopen.master import Master
from gapbridge.drivers.canopen.objects import (
    DISABLE_VOLTAGE,
    ENABLE_INTERPOLATION,
    ENABLE_OPERATION,
    FAULT_RESET,
    QUICK_STOP,
    TOWARDS_ENABLED,
    Address,
    State,
)
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.canopen.state import not_following, positions, states
from gapbridge.drivers.canopen.sync_set import SyncSet
from gapbridge.drivers.controller_facts import Difference

MODES_OF_OPERATION, CONSUMER_HEARTBEAT = Address(0x6060, 0), Address(0x1016, 1)
ABORT_CONNECTION = Address(0x6007, 0)
STOP_AT_LOSS = 3  # Abort connection option code: quick stop
STOPPING = 2.0  # s that a quick stop and disabling may take
STILL_SYNCS = 3  # SYNCs without a change of any count, after which the arm is at rest
OFF: tuple[State, ...] = (
    "SWITCH ON DISABLED", "READY TO SWITCH ON", "NOT READY TO SWITCH ON", "FAULT",
)  # fmt: skip
Near = Callable[[SyncSet], Array]  # a sample's joints (n,), rad, if the arm has not moved


class Power:
    """Brings all drives of one arm to OPERATION ENABLED and back."""

    def __init__(
        self,
        master: Master,
        profile: CanopenProfile,
        writer: RpdoWriter,
        exchange: Callable[[], SyncSet | None],
    ) -> None:
        self._master, self._profile, self._writer = master, profile, writer
        self._exchange, self._now = exchange, master.clock.monotonic
        self._modes: dict[int, int] = {}  # node -> Modes of operation before
        self._values: dict[tuple[int, Address], int] = {}  # node, object -> its value before
        self._unstoppable: list[int] = []  # nodes that cannot be told what to do at our loss

    @property
    def following(self) -> int:
        """Return the Controlword of a drive that follows setpoints."""
        interpolated = self._profile.file.mode == "interpolated position"
        return ENABLE_OPERATION | (ENABLE_INTERPOLATION if interpolated else 0)

    def look(self) -> None:
        """Find the drives without an abort connection option. Raises LinkError."""
        master, profile = self._master, self._profile
        self._unstoppable = [
            node for node in profile.nodes
            if profile.heartbeat.drives_wait
            and master.read_where_present(node, ABORT_CONNECTION) is None
        ]  # fmt: skip

    def doubts(self) -> list[Difference]:
        """Return what speaks against arming, and does not forbid it."""
        if not self._unstoppable:
            return []
        nodes = ", ".join(map(str, self._unstoppable))
        return [
            Difference(
                ("link", "profile"),
                f"no 0x6007 in node {nodes}: what it does when our heartbeat ends is not known",
                "a drive that can be told to make a quick stop then",
                sure=False,
            )
        ]

    def check_modes(self, sample: SyncSet) -> None:
        """Refuse a drive that somebody left enabled in another mode. Raises LinkError.

        At the change of mode it may follow a target of long ago, before ours reaches it.
        """
        for node, state in zip(self._profile.nodes, states(sample), strict=True):
            if state != "OPERATION ENABLED":
                continue
            mode = self._master.read(node, MODES_OF_OPERATION)
            if mode != self._profile.mode_number:
                raise WriteError(
                    f"{self._master.where}: node {node}: found {state} in mode {mode}, expected a "
                    "drive that is off: it may jump when its mode is changed"
                )

    def prepare(self) -> None:
        """Choose the mode, and have the drives watch our heartbeat. Raises LinkError."""
        master, profile, beat = self._master, self._profile, self._profile.heartbeat
        for node in profile.nodes:
            master.beat()
            if node not in self._modes:
                self._modes[node] = master.read(node, MODES_OF_OPERATION)
            master.write(node, MODES_OF_OPERATION, profile.mode_number)
            if beat.drives_wait:
                self._replace(node, ABORT_CONNECTION, STOP_AT_LOSS)
                watched = beat.our_node << 16 | round(1e3 * beat.drives_wait)
                if not self._replace(node, CONSUMER_HEARTBEAT, watched):
                    raise LinkError(
                        f"{master.where}: node {node} cannot watch our heartbeat (no 0x1016): it "
                        "would go on when we are gone; heartbeat.drives_wait 0 accepts that"
                    )

    def _replace(self, node: int, address: Address, value: int) -> bool:
        """Write an object until ``restore``; returns whether the drive has it. Raises LinkError."""
        before = self._master.read_where_present(node, address)
        if before is None:
            return False
        if address == CONSUMER_HEARTBEAT and before >> 16 & 0x7F == value >> 16:
            before = 0  # ours, of a process that was killed: our heartbeat will end
        self._values.setdefault((node, address), before)
        self._master.write(node, address, value)
        return True

    def restore(self) -> None:
        """Put back what ``prepare`` changed. Raises LinkError."""
        for (node, address), value in reversed(list(self._values.items())):
            self._master.beat()
            self._master.write(node, address, value)
            del self._values[node, address]
        for node, mode in list(self._modes.items()):
            self._master.write(node, MODES_OF_OPERATION, mode)
            del self._modes[node]

    def enable(self, sample: SyncSet, near: Near, within: float, clear_faults: bool) -> Array:
        """Enable all drives at the present joints; returns the joints (n,) that they hold, rad.

        ``sample`` is the newest sample, of which ``near`` returns the joints or raises WriteError:
        each goes out as a target. Raises WriteError too if a drive is not enabled in time.
        """
        hold: Array | None = None
        resetting = False
        end = self._now() + within
        while True:
            reported, present = states(sample), near(sample)
            enabled = all(state == "OPERATION ENABLED" for state in reported)
            if hold is None and enabled:
                hold = present
            if hold is not None and enabled and not_following(self._profile, sample) is None:
                return hold
            if self._now() > end:
                raise self._not_enabled(sample)
            resetting = not resetting and clear_faults
            commands = [self._towards(state, enabled, resetting) for state in reported]
            self._writer.send(commands, present if hold is None else hold)
            sample = self._exchange() or sample

    def _towards(self, state: State, all_enabled: bool, resetting: bool) -> int:
        """Return the next Controlword; a fault is reset by a rising edge."""
        if state == "FAULT":
            return FAULT_RESET if resetting else DISABLE_VOLTAGE
        if state == "OPERATION ENABLED" and all_enabled:
            return self.following
        return TOWARDS_ENABLED.get(state, DISABLE_VOLTAGE)

    def _not_enabled(self, sample: SyncSet) -> WriteError:
        joint = not_following(self._profile, sample) or 0
        counts, node = sample.counts[joint], self._profile.nodes[joint]
        mode = counts.get("Modes of operation display", self._profile.mode_number)
        return WriteError(
            f"{self._master.where}: node {node} does not follow setpoints: found "
            f"{states(sample)[joint]}, Statusword 0x{counts['Statusword']:04X}, mode {mode}, "
            f"expected OPERATION ENABLED in mode {self._profile.mode_number}{self.emergency(node)}"
        )

    def emergency(self, node: int) -> str:
        """Return a node's active emergency as text for messages; empty: none."""
        heartbeats = self._master.heartbeats
        active = heartbeats.active.get(node) if heartbeats is not None else None
        return f" ({active})" if active is not None else ""

    def disable(self) -> None:
        """Stop by quick stop, wait until the arm is at rest, and switch off. Raises LinkError.

        Drives that do not answer are sent the commands too.
        """
        profile, end = self._profile, self._now() + STOPPING
        reported: list[State] = ["OPERATION ENABLED"] * profile.n
        q, still = self._writer.target, 0
        while True:
            if q is not None:
                late = self._now() > end - 0.5 * STOPPING
                word = DISABLE_VOLTAGE if still >= STILL_SYNCS or late else QUICK_STOP
                moving = "OPERATION ENABLED"
                commands = [QUICK_STOP if s == moving and not late else word for s in reported]
                self._writer.send(commands, q)
            sample = self._exchange()
            if sample is not None:
                reported, now = states(sample), positions(profile, sample)
                still = still + 1 if q is not None and (now == q).all() else 0
                q = now
                if all(state in OFF for state in reported):
                    self._writer.reset()
                    return
            if self._now() > end:
                raise WriteError(
                    f"{self._master.where}: not all drives have reported that they are off "
                    f"{STOPPING:g} s after the quick stop"
                )
