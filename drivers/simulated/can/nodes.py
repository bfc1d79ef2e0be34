"""Base class of simulated arms on CAN: the bus, its hub, and joints in wire units."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import can

from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can_bus.bus import BusSettings, close_bus, open_bus
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.frame import Frame
from gapbridge.drivers.simulated.can.hub import Hub
from gapbridge.drivers.simulated.can.port import InnerPort
from gapbridge.drivers.simulated.plant.kinematics import Joints
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.server.bench import Command
from gapbridge.drivers.simulated.server.connection import is_free
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer

BACKLOG = 500  # frames read in one cycle at most
TORN = 0.05  # rad: error of the joints of a torn sample


class CanNodes(ProtocolServer):
    """An arm's nodes on one bus.

    With socketcand the bus is served here, with slcan its serial line (a link to it is put at
    ``channel``); on virtual and socketcan the nodes join the bus that is there.
    """

    def __init__(self, link: CanSettings, host: str, controller: ArmController) -> None:
        self.name = f"CAN ({link.profile})"
        self._link = link.model_copy(update={"host": host})
        n = controller.n
        self._sign: Sequence[float] = link.direction or (1,) * n
        self._zero: Sequence[float] = link.zero or (0.0,) * n
        self._gear: Sequence[float] = link.gear or (1.0,) * n
        self._bus: Any = None
        self._hub: Hub | None = None
        self._inner = InnerPort()
        self._symbol: Path | None = None
        self.withheld: set[int] = set()  # identifiers that are not sent now
        self._kept: Joints = controller.q
        self._tears: deque[frozenset[int]] = deque()
        self._lost: frozenset[int] = frozenset()  # identifiers not sent in this sample
        self._shift = 0.0  # rad: error of a torn sample, which makes its use visible

    # -- the bus ----------------------------------------------------------------------------------

    def open(self, controller: ArmController, clock: Clock) -> None:
        """Serve or join the bus. Raises LinkError, OSError, InputError."""
        link: BusSettings = self._link
        if link.interface in ("socketcand", "slcan"):
            port = link.port if link.interface == "socketcand" else 0
            host = link.host if link.interface == "socketcand" else "127.0.0.1"
            self._hub = Hub(clock, host, port)
            self._hub.start()
            if link.interface == "slcan":
                self._put_terminal(Path(link.channel))
            self._inner = InnerPort()
            self._hub.attach(self._inner)
            return
        if link.interface not in ("virtual", "socketcan"):
            raise InputError(
                f"found {link.interface!r}, which cannot be simulated, expected socketcand, slcan, "
                "virtual or socketcan",
                ("link", "interface"),
            )
        self._bus = open_bus(link)

    def _put_terminal(self, channel: Path) -> None:
        assert self._hub is not None
        if not is_free(channel):
            raise InputError(
                f"found {channel}, expected a name that is free, as /tmp/arm, where a link to the "
                "simulated serial line can be put",
                ("link", "channel"),
            )
        channel.unlink(missing_ok=True)
        channel.symlink_to(self._hub.add_terminal())
        self._symbol = channel

    @property
    def port(self) -> int:
        """Return the TCP port of the bus that is served here; 0: none."""
        return self._hub.port if self._hub else 0

    def close(self) -> None:
        """Close the bus, and end it if it is served here."""
        bus, self._bus = self._bus, None
        if bus is not None:
            close_bus(bus)
        hub, self._hub = self._hub, None
        if hub is not None:
            hub.close()
        symbol, self._symbol = self._symbol, None
        if symbol is not None:
            symbol.unlink(missing_ok=True)

    def cycle(self, controller: ArmController) -> None:
        """Read the frames that have arrived, then send the arm's frames."""
        if self._bus is None and self._hub is None:
            return
        for _ in range(BACKLOG):
            frame = self._receive()
            if frame is None:
                break
            if not controller.stalled:
                self.take(frame.id, frame.data, controller)
        if not controller.stalled:
            if not controller.frozen:
                self._kept = controller.q
            self.publish(controller)

    def _receive(self) -> Frame | None:
        """Return the next data frame, or None. Raises LinkError if the bus is lost."""
        if self._hub is not None:
            return self._inner.frames.popleft() if self._inner.frames else None
        while True:
            try:
                message = self._bus.recv(0.0)
            except (can.CanError, OSError) as error:
                raise LinkError(f"simulated arm: {error}") from None
            if message is None:
                return None
            if not message.is_remote_frame and not message.is_error_frame:
                extended = bool(message.is_extended_id)
                return Frame(int(message.arbitration_id), bytes(message.data), extended)

    def tear(self, first: int, second: int) -> None:
        """Drop frame ``second`` of the next sample and ``first`` of the one after, with an error.

        A reader that only waits for each identifier mixes the two.
        """
        self._tears.extend((frozenset({second}), frozenset({first})))

    def begin_sample(self) -> None:
        """Begin a new sample; protocols call it."""
        before, self._shift = self._shift, 0.0
        self._lost = self._tears.popleft() if self._tears else frozenset()
        if self._lost and not before:
            self._shift = TORN

    def send(self, identifier: int, data: bytes) -> None:
        """Send one frame, unless it is withheld."""
        if identifier in self.withheld or identifier in self._lost:
            return
        extended = identifier > 0x7FF
        if self._hub is not None:
            self._hub.send(Frame(identifier, data, extended), self._inner)
            return
        frame = can.Message(arbitration_id=identifier, is_extended_id=extended, data=data)
        with contextlib.suppress(can.CanError, OSError):
            self._bus.send(frame)

    def commands(self, controller: ArmController) -> Mapping[str, Command]:
        """Return the bench commands of a bus: lost frames."""
        return {
            "withhold": (1, lambda arguments: self.withheld.add(int(arguments[0])),
                         "withhold ID: frames of this identifier get lost"),
            "resume": (0, lambda _: self.withheld.clear(), "resume: no frames get lost any more"),
        }  # fmt: skip

    # -- joints -----------------------------------------------------------------------------------

    def wire(self, unit: float) -> list[float]:
        """Return the encoders in wire units of ``unit`` rad."""
        rows = zip(self._kept, self._zero, self._sign, self._gear, strict=True)
        return [(q + self._shift - zero) * sign * gear / unit for q, zero, sign, gear in rows]

    def speeds(self, controller: ArmController, unit: float) -> list[float]:
        """Return the joint velocities in wire units of ``unit`` rad/s."""
        rows = zip(controller.qd, self._sign, self._gear, strict=True)
        return [qd * sign * gear / unit for qd, sign, gear in rows]

    def joint(self, i: int, value: float, unit: float) -> float:
        """Return joint ``i`` (from 0), rad, of a value in wire units."""
        return value * unit * self._sign[i] / self._gear[i] + self._zero[i]

    # -- of one protocol --------------------------------------------------------------------------

    @abstractmethod
    def take(self, identifier: int, data: bytes, controller: ArmController) -> None:
        """Process one received frame."""

    @abstractmethod
    def publish(self, controller: ArmController) -> None:
        """Send the arm's frames of this cycle."""
