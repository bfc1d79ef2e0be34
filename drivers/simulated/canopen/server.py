"""An arm of simulated CiA 402 drives on one bus, for any CANopen profile."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from typing import Any, NamedTuple

import canopen
from canopen.network import MessageListener

from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.can_bus.bus import BusSettings, close_bus, open_bus
from gapbridge.drivers.canopen.profile import CanopenProfile, read_profile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.hub import Hub
from gapbridge.drivers.simulated.canopen.axis import follow_stops, move_axes
from gapbridge.drivers.simulated.canopen.drive import COMMUNICATION, Drive, Units
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.server.bench import BenchError, Command
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer

SYNC = 0x80
HEARTBEAT = 0x700
FOLLOWING_ERROR, HEARTBEAT_ERROR = 0x8611, 0x8130  # error codes
OFF_BY = 0.05  # rad: error of a late TPDO, which makes its use for the next SYNC visible
PAUSE = 0.02  # s


class DelayedPdo(NamedTuple):
    """A TPDO that is sent late."""

    due: float  # s, monotonic
    sync: int  # number of the SYNC that it answers
    cob_id: int
    data: bytes
    off: bytes  # its data if another SYNC has come meanwhile


class _Network(canopen.Network):
    """The drives' side of the bus: silent nodes send nothing."""

    NOTIFIER_CYCLE = 0.05
    NOTIFIER_SHUTDOWN_TIMEOUT = 1.0

    def __init__(self, bus: Any) -> None:
        super().__init__(bus)
        self.silent: set[int] = set()
        self._mute = False

    def set_mute(self, mute: bool) -> None:
        """Mute or unmute all nodes."""
        self._mute = mute

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        if not self._mute and can_id & 0x7F not in self.silent:
            with contextlib.suppress(Exception):  # the bus is lost: the server's cycle detects it
                super().send_message(can_id, data, remote)


class _Listener(MessageListener):
    """Passes frames to the server, one at a time."""

    def __init__(self, server: CanopenServer, network: Any, clock: Clock) -> None:
        super().__init__(network)
        self._server, self._clock = server, clock

    def on_message_received(self, msg: Any) -> None:
        if msg.is_error_frame or msg.is_remote_frame or msg.is_extended_id:
            return
        with self._server.lock:
            super().on_message_received(msg)  # type: ignore[no-untyped-call]
            self._server.take_frame(int(msg.arbitration_id), bytes(msg.data))

    def on_error(self, exc: Exception) -> None:
        self._clock.sleep(PAUSE)  # the bus is lost: the server's cycle detects it


class CanopenServer(ProtocolServer):
    """All drives of one arm.

    With socketcand the bus is served here; on virtual and socketcan the drives join the bus.
    """

    def __init__(self, link: CanopenSettings, host: str, controller: ArmController) -> None:
        self.profile: CanopenProfile = read_profile(link.profile_path, controller.n)
        self.name = f"CANopen ({self.profile.name})"
        self._link: BusSettings = link.model_copy(update={"host": host})
        self.lock = threading.RLock()
        self._hub: Hub | None = None
        self._network: Any = None
        self._controller = controller
        self._late: dict[int, tuple[int, float]] = {}  # node -> SYNCs left, s of delay
        self._delayed: list[DelayedPdo] = []
        self._syncs = 0  # answered
        self._beaten: dict[int, float] = {}  # node -> s, of its last heartbeat
        self._was_able = True
        self.drives = tuple(self._drive(joint) for joint in range(controller.n))

    def _drive(self, joint: int) -> Drive:
        profile, controller = self.profile, self._controller
        per_radian = float(profile.counts_per_radian[joint])
        rated = profile.file.joints[joint].rated_torque
        sign = 1.0 if per_radian > 0.0 else -1.0
        units = Units(
            per_radian, float(profile.zero[joint]), 1.0 / (profile.file.velocity_scale or 1.0),
            0.0 if rated is None else 1000.0 * sign / rated,
        )  # fmt: skip
        node = profile.nodes[joint]
        return Drive(node, profile.eds.dictionary(node), units, controller.q[joint])

    # -- the bus ----------------------------------------------------------------------------------

    def open(self, controller: ArmController, clock: Clock) -> None:
        """Serve or join the bus, and start the drives. Raises LinkError, OSError, InputError."""
        link, self._now = self._link, clock.monotonic
        if link.interface == "socketcand":
            self._hub = Hub(clock, link.host, link.port)
            self._hub.start()
            link = link.model_copy(update={"port": self._hub.port})
        elif link.interface not in ("virtual", "socketcan"):
            raise InputError(
                f"found {link.interface!r}, which cannot be simulated, expected socketcand, "
                "virtual or socketcan",
                ("link", "interface"),
            )
        network: Any = _Network(open_bus(link))
        network.listeners[:] = [_Listener(self, network, clock)]
        with self.lock:
            self._network = network
            for drive in self.drives:
                network.add_node(drive)
            network.connect()
            for joint in range(controller.n):
                self._boot(joint)

    def _boot(self, joint: int) -> None:
        arm = self._controller.plant.arm
        q = self._controller.q[joint]
        self.drives[joint].boot(q, arm.lower[joint], arm.upper[joint])

    @property
    def port(self) -> int:
        """Return the TCP port of the bus that is served here; 0: none."""
        return self._hub.port if self._hub else 0

    def close(self) -> None:
        """Close the bus, and end it if it is served here."""
        with self.lock:
            network, self._network = self._network, None
        if network is not None:
            bus = network.bus
            with contextlib.suppress(Exception):
                network.disconnect()
            close_bus(bus)
            for drive in self.drives:
                drive.remove_network()
        hub, self._hub = self._hub, None
        if hub is not None:
            hub.close()

    # -- frames -----------------------------------------------------------------------------------

    def take_frame(self, cob_id: int, data: bytes) -> None:
        """Process one frame, after the library; from the notifier's thread."""
        if self._network is None or self._controller.stalled:
            return
        if cob_id == 0:
            for joint, drive in enumerate(self.drives):
                if drive.nmt.state == "INITIALISING":
                    self._boot(joint)
        elif cob_id == SYNC:
            self._answer_sync()
        elif cob_id & 0x780 == HEARTBEAT:
            for drive in self.drives:
                if drive.number(0x1016, 1) >> 16 & 0x7F == cob_id & 0x7F:
                    drive.watched[cob_id & 0x7F] = self._controller.running
        else:
            for drive in self.drives:
                if drive.operational and drive.node not in self._network.silent:
                    drive.receive(cob_id, data)

    def _answer_sync(self) -> None:
        """Send every drive's TPDOs, then apply the setpoints received before this SYNC."""
        self._syncs += 1
        for drive in self.drives:
            if not drive.operational:
                continue
            if drive.node in self._late:
                self._delay(drive)
                continue
            for cob_id, data in drive.samples():
                self._network.send_message(cob_id, data)
        for drive in self.drives:
            listens = drive.operational and drive.node not in self._network.silent
            if listens and not drive.take_setpoints():
                drive.fail(FOLLOWING_ERROR)

    def _delay(self, drive: Drive) -> None:
        count, delay = self._late.pop(drive.node)
        if count > 1:
            self._late[drive.node] = (count - 1, delay)
        due, right = self._now() + delay, drive.samples()
        wrong = drive.samples_off_by(OFF_BY)
        self._delayed += [
            DelayedPdo(due, self._syncs, cob_id, data, off)
            for (cob_id, data), (_, off) in zip(right, wrong, strict=True)
        ]

    def _send_delayed(self, now: float) -> None:
        due = [pdo for pdo in self._delayed if pdo.due <= now]
        self._delayed = [pdo for pdo in self._delayed if pdo.due > now]
        for pdo in due:
            data = pdo.data if pdo.sync == self._syncs else pdo.off
            self._network.send_message(pdo.cob_id, data)

    def delay_tpdos(self, node: float, delay: float, count: int = 1) -> None:
        """Delay a node's TPDOs by ``delay`` s at the next ``count`` SYNCs."""
        with self.lock:
            self._late[self.drives[self._joint_of(node)].node] = (count, delay)

    # -- the cycle --------------------------------------------------------------------------------

    def cycle(self, controller: ArmController) -> None:
        """Move the axes, watch and send heartbeats."""
        with self.lock:
            if self._network is None:
                return
            self._network.set_mute(controller.stalled)
            self._was_able = follow_stops(controller, self.drives, self._was_able)
            self._send_delayed(self._now())
            self._watch_heartbeats(controller)
            axes = ((drive.axis, drive.interpolation_period) for drive in self.drives)
            move_axes(controller, controller.period, axes)
            if not controller.frozen:
                self._measure(controller)
            self._send_heartbeats(controller)
            try:
                self._network.check()
            except Exception as error:
                raise LinkError(f"simulated drives: {error}") from None

    def _watch_heartbeats(self, controller: ArmController) -> None:
        for drive in self.drives:
            limit = 1e-3 * (drive.number(0x1016, 1) & 0xFFFF)
            for node, last in list(drive.watched.items()):
                if limit and controller.running - last > limit:
                    del drive.watched[node]
                    drive.emcy.send(HEARTBEAT_ERROR, COMMUNICATION)
                    self._abort_connection(drive)

    @staticmethod
    def _abort_connection(drive: Drive) -> None:
        """Execute the abort connection option (0x6007)."""
        option = drive.number(0x6007)
        if option == 1:
            drive.fail(HEARTBEAT_ERROR, COMMUNICATION)
        elif option in (2, 3):
            drive.axis.machine.control(0x00 if option == 2 else 0x02)

    def _measure(self, controller: ArmController) -> None:
        torque = controller.joint_torque
        for joint, drive in enumerate(self.drives):
            drive.measure(controller.q[joint], controller.qd[joint], torque[joint])

    def _send_heartbeats(self, controller: ArmController) -> None:
        for drive in self.drives:
            period = drive.nmt.period
            if period and controller.running - self._beaten.get(drive.node, -1.0) >= period:
                self._beaten[drive.node] = controller.running
                state = {"OPERATIONAL": 5, "STOPPED": 4}.get(drive.nmt.state, 127)
                self._network.send_message(HEARTBEAT + drive.node, [state])

    # -- the bench --------------------------------------------------------------------------------

    def _joint_of(self, node: float) -> int:
        """Return the joint, from 0, of a node. Raises BenchError."""
        if node not in self.profile.nodes:
            raise BenchError(f"found node {node:g}, expected one of {self.profile.nodes}")
        return self.profile.nodes.index(int(node))

    def mute(self, node: float) -> None:
        """Mute a node, as if its plug were pulled."""
        with self.lock:
            self._network.silent.add(self.drives[self._joint_of(node)].node)

    def unmute(self) -> None:
        """Unmute all nodes."""
        with self.lock:
            self._network.silent.clear()

    def restart(self, node: float) -> None:
        """Restart a node, as after a dip of its supply."""
        with self.lock:
            self._boot(self._joint_of(node))

    def fail(self, node: float, code: int) -> None:
        """Have a drive fail with an error code."""
        with self.lock:
            self.drives[self._joint_of(node)].fail(code)

    def commands(self, controller: ArmController) -> Mapping[str, Command]:
        """Return the bench commands of drives."""
        return {
            "silence": (1, lambda arguments: self.mute(arguments[0]),
                        "NODE: this drive sends nothing any more"),
            "speak": (0, lambda _: self.unmute(), "all drives send again"),
            "restart": (1, lambda arguments: self.restart(arguments[0]),
                        "NODE: this drive restarts"),
            "fail": (2, lambda arguments: self.fail(arguments[0], int(arguments[1]) & 0xFFFF),
                     "NODE CODE: this drive goes to FAULT with an error code"),
            "late": (2, lambda arguments: self.delay_tpdos(arguments[0], max(arguments[1], 0.0)),
                     "NODE SECONDS: its next TPDOs come so late"),
        }  # fmt: skip


def make_servers(
    link: CanopenSettings, host: str, controller: ArmController
) -> list[ProtocolServer]:
    """Return the drives of an arm, not yet on a bus. Raises InputError if they do not fit."""
    return [CanopenServer(link, host, controller)]
