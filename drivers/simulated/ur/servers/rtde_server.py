"""RTDE on port 30004: requests, recipes, claims and one data packet per cycle and client."""

from __future__ import annotations

import logging
import socket
import struct
from typing import Any

from gapbridge.drivers.simulated.server.connection import Connection
from gapbridge.drivers.simulated.ur.controller import Controller
from gapbridge.drivers.simulated.ur.rtde_names import INPUTS
from gapbridge.drivers.simulated.ur.servers import rtde_protocol as wire

log = logging.getLogger("drivers.simulated")

FREQUENCY = 500.0  # Hz, e-Series
UNREAD_LIMIT = 10.0  # s after which a connection that does not read is closed
VERSIONS = (1, 2)


class RtdeSession(Connection):
    """One RTDE client."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        self.version = 1
        self.recipe: wire.OutputRecipe | None = None
        self.inputs: dict[int, wire.InputRecipe] = {}
        self.claims: set[str] = set()
        self.started = False
        self.countdown = 0
        self.unread = 0.0  # s for which the client has not taken anything
        self.odd_lengths: set[int] = set()

    def speak_version(self, version: int) -> None:
        """Speak another version of the protocol from now on."""
        self.version = version

    def set_outputs(self, recipe: wire.OutputRecipe) -> None:
        """Set a new recipe; packets start when the client requests them."""
        self.recipe, self.started = recipe, False

    def start(self) -> bool:
        """Begin to send packets; returns whether there is a recipe for them."""
        self.started = self.recipe is not None and self.recipe.complete
        self.countdown = 0
        return self.started

    def pause(self) -> None:
        """Send no more packets."""
        self.started = False

    def publish(self, memory: dict[str, Any], dt: float) -> None:
        """Send the cycle's packet if it is due and there is room."""
        if self.pending:
            self.flush()
        if not self.started or self.recipe is None:
            return
        self.countdown -= 1
        if self.countdown > 0:
            return
        self.countdown = self.recipe.every
        if self.pending:  # never queue: this packet is dropped
            self._count_unread(dt * self.recipe.every)
            return
        self.unread = 0.0
        self.send(self.recipe.encode(memory))

    def _count_unread(self, dt: float) -> None:
        self.unread += dt
        if self.unread > UNREAD_LIMIT:
            log.warning("an RTDE client has not read for %.0f s and is closed", self.unread)
            self.close()


class RtdeServer:
    """All RTDE clients of one controller."""

    def __init__(self, controller: Controller, version: tuple[int, int, int, int]) -> None:
        self._controller = controller
        self._version = version
        self.sessions: list[RtdeSession] = []

    def accept(self, sock: socket.socket) -> RtdeSession:
        """Accept a new client."""
        session = RtdeSession(sock)
        self.sessions.append(session)
        return session

    def publish(self, dt: float) -> None:
        """Send the cycle's packet to every client that is due and has room."""
        if self._controller.clock < self._controller.stall_until:
            return
        for session in self.sessions:
            session.publish(self._controller.memory, dt)

    def close_all(self) -> None:
        """Close every client's connection."""
        for session in self.sessions:
            session.close()

    def drop_closed(self) -> None:
        """Forget closed sessions; their claims go with them."""
        if not all(session.open for session in self.sessions):
            self.sessions = [session for session in self.sessions if session.open]

    def handle(self, session: RtdeSession) -> None:
        """Answer every complete request that has arrived."""
        try:
            while session.open and (got := wire.take_frame(session.received)) is not None:
                self._dispatch(session, *got)
        except wire.FrameError as error:
            log.warning("%s: connection closed", error)
            session.close()

    def _dispatch(self, session: RtdeSession, kind: int, payload: bytes) -> None:
        if kind == wire.DATA:
            self._take_data(session, payload)
        elif kind == wire.REQUEST_VERSION:
            self._negotiate(session, payload)
        elif kind == wire.CONTROLLER_VERSION:
            session.send(wire.frame(kind, struct.pack(">4I", *self._version)))
        elif kind == wire.SETUP_OUTPUTS:
            self._set_up_outputs(session, payload)
        elif kind == wire.SETUP_INPUTS:
            self._set_up_inputs(session, payload)
        elif kind == wire.START:
            session.send(wire.frame(kind, bytes([session.start()])))
        elif kind == wire.PAUSE:
            session.pause()
            session.send(wire.frame(kind, b"\x01"))
        elif kind == wire.TEXT:
            log.info("RTDE text from a client: %r", payload)
        else:
            log.warning("RTDE request of unknown type %d", kind)

    def _negotiate(self, session: RtdeSession, payload: bytes) -> None:
        version = struct.unpack_from(">H", payload)[0] if len(payload) >= 2 else 0
        accepted = version in VERSIONS
        if accepted:
            session.speak_version(version)
        session.send(wire.frame(wire.REQUEST_VERSION, bytes([accepted])))

    def _set_up_outputs(self, session: RtdeSession, payload: bytes) -> None:
        every = 1
        if session.version == 2 and len(payload) >= 8:
            frequency = struct.unpack_from(">d", payload)[0]
            payload = payload[8:]
            if 0.0 < frequency < FREQUENCY:
                every = max(int(FREQUENCY / frequency), 1)
        names = wire.split_names(payload)
        recipe = wire.output_recipe(names, session.version, every)
        session.set_outputs(recipe)
        head = bytes([recipe.complete]) if session.version == 2 else b""
        session.send(wire.frame(wire.SETUP_OUTPUTS, head + ",".join(recipe.types).encode()))

    def _set_up_inputs(self, session: RtdeSession, payload: bytes) -> None:
        names = wire.split_names(payload)
        claimed = {n for other in self.sessions if other is not session for n in other.claims}
        types = ["IN_USE" if name in claimed else INPUTS.get(name, "NOT_FOUND") for name in names]
        number = 0
        recipe = wire.input_recipe(names)
        if recipe is not None and not claimed.intersection(names):
            number = len(session.inputs) + 1
            session.inputs[number] = recipe
            session.claims.update(names)
        session.send(wire.frame(wire.SETUP_INPUTS, bytes([number]) + ",".join(types).encode()))

    def _take_data(self, session: RtdeSession, payload: bytes) -> None:
        recipe = session.inputs.get(payload[0]) if payload else None
        if recipe is None:
            log.warning("RTDE data for an input recipe that does not exist")
            return
        body = payload[1:]
        if len(body) != recipe.layout.size and payload[0] not in session.odd_lengths:
            session.odd_lengths.add(payload[0])
            log.warning(
                "input recipe %d: %d bytes came where %d are expected; what fits is taken",
                payload[0], len(body), recipe.layout.size,
            )  # fmt: skip
        self._controller.write_inputs(recipe.decode(body))
