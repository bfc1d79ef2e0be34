"""A CAN bus by its settings: python-can's interfaces, opened and closed safely.

python-can is the top-level package ``can``; this package is ``drivers.can``. It is imported when a
bus is opened, so that a cell is read without it.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, Field, ValidationInfo, field_validator

from gapbridge.core.errors import LinkError, first_line
from gapbridge.drivers.section import Host

if TYPE_CHECKING:
    import can

SOCKETCAND_PORT = 29536
REACHABLE = 2.0  # s until a server must have answered


class BusSettings(BaseModel):
    """The keys of a section that say which CAN bus."""

    interface: str = Field(
        "socketcan", min_length=1,
        description="python-can's name: socketcan, socketcand, slcan, virtual, pcan, kvaser, ...",
    )  # fmt: skip
    channel: str = Field("can0", min_length=1, description="can0, /dev/ttyACM0, ...")
    host: Host = Field("127.0.0.1", min_length=1, description="socketcand: where it is served")
    port: int = Field(SOCKETCAND_PORT, ge=1, le=65535, description="socketcand: its TCP port")
    bitrate: int = Field(1_000_000, ge=10_000, le=8_000_000, description="bit/s")
    options: dict[str, bool | int | float | str] = Field(
        {}, description="further arguments of python-can's interface"
    )

    @field_validator("interface")
    @classmethod
    def _known(cls, value: str) -> str:
        """Refuse an interface that python-can does not have."""
        import can

        if value not in can.VALID_INTERFACES:
            raise ValueError(f"expected one of {', '.join(sorted(can.VALID_INTERFACES))}")
        return value

    def where(self) -> str:
        """Return how messages call this bus."""
        server = f"@{self.host}:{self.port}" if self.interface == "socketcand" else ""
        return f"{self.interface} {self.channel}{server}"


class ArmBusSettings(BusSettings):
    """A bus on which an arm is moved: other masters, frozen joints, motion when enabled."""

    foreign_quiet: float = Field(
        1.0, gt=0.0, le=10.0, description="s without a frame of another master before we may write"
    )
    frozen_after: float = Field(
        0.5, gt=0.0, le=10.0,
        description="s that joints may stand still, count by count, though commanded away",
    )  # fmt: skip
    frozen_distance: float = Field(
        0.02, gt=0.0, le=0.5, description="rad of command from joint that counts as away"
    )
    arming_distance: float = Field(
        0.03, gt=0.0, le=0.3, description="rad that a joint may give while it is enabled"
    )

    @field_validator("options")
    @classmethod
    def _no_echoes(cls, value: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        """Refuse echoes of our own frames where they look like another program's; see is_own."""
        if info.data.get("interface") == "socketcan" and value.get("receive_own_messages"):
            raise ValueError(
                "expected no receive_own_messages on socketcan: our own frames would be taken for "
                "another commander's"
            )
        return value


def is_own(frame: Any, settings: BusSettings) -> bool:
    """Return whether a frame is one of ours that the interface returned.

    On socketcan ``is_rx`` is False for a frame of any program on this computer, a second commander
    there too, and ours are not returned.
    """
    return not frame.is_rx and settings.interface != "socketcan"


def open_bus(settings: BusSettings, filters: list[can.typechecking.CanFilter] | None = None) -> Any:
    """Return an open ``can.BusABC``. Raises LinkError, soon, if there is no such bus.

    ``filters`` are python-can's, in the kernel or the adapter if it supports them.
    """
    arguments: dict[str, Any] = {"interface": settings.interface, "channel": settings.channel}
    if settings.interface == "socketcand":
        return _open_socketcand(settings, filters)
    if settings.interface not in ("virtual", "socketcan", "udp_multicast"):
        arguments["bitrate"] = settings.bitrate
    if settings.interface == "slcan":
        arguments["sleep_after_open"] = 0.0 if _is_terminal(settings.channel) else 2.0
    arguments.update(settings.options)
    return _opened(settings, filters, arguments)


def _is_terminal(channel: str) -> bool:
    """Return whether the channel is a pseudo-terminal, which needs no start-up time."""
    return os.path.realpath(channel).startswith("/dev/pts/")


def _opened(settings: BusSettings, filters: Any, arguments: dict[str, Any]) -> Any:
    import can

    try:
        if settings.interface == "slcan":
            return _open_slcan(filters, arguments)
        return can.Bus(can_filters=filters, **arguments)
    except Exception as error:  # NameError too: kvaser's without its library
        missing = " (is its library installed?)" if isinstance(error, NameError) else ""
        raise LinkError(
            f"{settings.where()}: cannot be opened: {first_line(error)}{missing}"
        ) from None


def _open_slcan(filters: Any, arguments: dict[str, Any]) -> Any:
    from gapbridge.drivers.can_bus.slcan import SlcanBus

    options = {name: value for name, value in arguments.items() if name != "interface"}
    bus = SlcanBus(can_filters=filters, **options)
    _without_delay(bus)
    return bus


def _without_delay(bus: Any) -> None:
    """Switch off Nagle's delay where a serial adapter is reached over TCP (44 ms otherwise)."""
    link = getattr(bus.serialPortOrig, "_socket", None)
    if isinstance(link, socket.socket):
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _open_socketcand(settings: BusSettings, filters: Any) -> Any:
    """Ask first whether anyone listens: the library would try for ten seconds in a busy loop."""
    try:
        socket.create_connection((settings.host, settings.port), timeout=REACHABLE).close()
    except OSError as error:
        why = error.strerror or type(error).__name__
        raise LinkError(f"{settings.where()}: cannot be reached: {why}") from None
    import can

    from gapbridge.drivers.can_bus.socketcand import SocketcandBus

    options = {"tcp_tune": True, **settings.options}
    try:
        return SocketcandBus(  # type: ignore[no-untyped-call]
            settings.channel, settings.host, settings.port, can_filters=filters, **options
        )
    except (can.CanError, OSError, TypeError, ValueError) as error:
        raise LinkError(f"{settings.where()}: cannot be opened: {first_line(error)}") from None


def close_bus(bus: Any) -> None:
    """Close a bus whatever state it is in; slcan's shutdown raises after the peer's death."""
    with contextlib.suppress(Exception):
        bus.shutdown()
    port = getattr(bus, "serialPortOrig", None)
    if port is not None:
        with contextlib.suppress(Exception):
            port.close()
