"""The simulated sensor of a cell, at the address that the cell's ``ft_sensor`` names."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.addresses import is_loopback
from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.ft_sensor.settings import (
    AtiSettings,
    FtSensorSettings,
    RobotiqSettings,
    RobotousSettings,
)
from gapbridge.drivers.simulated.can.hub import Hub
from gapbridge.drivers.simulated.ft_sensor.ati_node import AtiNode, RobotousNode
from gapbridge.drivers.simulated.ft_sensor.ft300_device import Ft300Device
from gapbridge.drivers.simulated.ft_sensor.node import Reaction, SimulatedSensor, reaction_at
from gapbridge.drivers.simulated.server.connection import is_free

RETRY = 0.1  # s between two tries at a bus that somebody else serves
BETWEEN_PROCESSES = ("socketcand", "socketcan")


@contextlib.contextmanager
def served_sensor(
    settings: FtSensorSettings | None, in_flange: Callable[[], Sequence[float]], clock: Clock,
    link: object = None,
) -> Iterator[None]:  # fmt: skip
    """Serve the sensor of a cell while the ``with`` block lasts; None: nothing to serve.

    ``in_flange`` returns the plant's wrench on the flange (6,). A CAN bus over socketcand is served
    here too, unless ``link`` is on the same one: then the arm's server serves it. Raises InputError
    where the sensor cannot be simulated at its address, LinkError where that is taken.
    """
    if settings is None:
        yield
        return
    frame = settings.sensor_in_flange
    reaction = reaction_at(in_flange, frame.xyz, frame.rpy, settings.sign)
    sensor = _device(settings, reaction, clock)
    with contextlib.ExitStack() as stack:
        if isinstance(settings, BusSettings) and settings.interface == "socketcand":
            if _same_bus(settings, link):
                stack.enter_context(_started_later(sensor, clock))
                yield
                return
            stack.enter_context(contextlib.closing(_hub(settings, clock)))
        stack.enter_context(sensor)
        yield


def _device(settings: FtSensorSettings, reaction: Reaction, clock: Clock) -> SimulatedSensor:
    if isinstance(settings, RobotiqSettings):
        port = Path(settings.port)
        if not is_free(port):
            raise InputError(
                f"ft_sensor.port: found {settings.port}, expected a name that is free, as "
                "/tmp/ft300, where a link to the simulated line can be put"
            )
        return Ft300Device(reaction, clock, port, settings.device_id)
    if isinstance(settings, BusSettings) and settings.interface not in BETWEEN_PROCESSES:
        raise InputError(
            f"ft_sensor.interface: found {settings.interface!r}, expected socketcand or socketcan: "
            "a simulated sensor is reached from another process"
        )
    if isinstance(settings, RobotousSettings):
        return RobotousNode(
            reaction, settings, clock, settings.command_id, settings.reply_ids, settings.rate
        )
    if isinstance(settings, AtiSettings):
        return AtiNode(reaction, settings, settings.base_id)
    raise InputError(f"ft_sensor.driver: found {settings.driver!r}, which cannot be simulated")


def _same_bus(settings: BusSettings, link: object) -> bool:
    keys = ("interface", "host", "port")
    return all(getattr(link, key, None) == getattr(settings, key) for key in keys)


def _hub(settings: BusSettings, clock: Clock) -> Hub:
    if not is_loopback(settings.host):
        raise InputError(
            f"ft_sensor.host: found {settings.host!r}, expected a loopback address (127.x.x.x): "
            "a simulated sensor is never served to others"
        )
    try:
        return Hub(clock, settings.host, settings.port).start()
    except OSError as error:
        raise LinkError(f"{settings.where()}: cannot be served: {error.strerror}") from None


@contextlib.contextmanager
def _started_later(sensor: SimulatedSensor, clock: Clock) -> Iterator[None]:
    """Start the sensor as soon as its bus is served."""
    ended = threading.Event()

    def wait_for_bus() -> None:
        while not clock.wait(ended, RETRY):
            with contextlib.suppress(LinkError):
                sensor.start()
                return

    thread = threading.Thread(target=wait_for_bus, name="simulated sensor's start", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(5.0)
        sensor.stop()
