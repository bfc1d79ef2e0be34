"""One owner per controller: a lock that is held for a run and never outlives its process."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import ipaddress
import json
import os
import socket
import sys
from pathlib import Path
from typing import Any, Self

from bridge.ipc.runtime_folder import runtime_folder
from core.errors import InputError
from drivers.driver import DriverSettings

OWN_PORTS = (502, 802, 30004)  # Modbus/TCP, Modbus/TCP Security, RTDE


def address_of(link: DriverSettings) -> str:
    """Return what tells one controller from another: the same for whatever driver reaches it.

    A host is what its name resolves to, once for the whole run. A port is left out where it is the
    protocol's own: RTDE and Modbus of one robot are one controller, ports of a gateway are not.
    """
    given = link.model_dump(mode="json")
    if "interface" in given:  # a bus, with a whole arm by each profile
        host = given.get("host")
        bus = {**given, "host": None if host is None else resolved(str(host))}
        names = ("interface", "host", "port", "channel", "profile")
        return "bus " + " ".join(f"{bus.get(k)}" for k in names)
    if given.get("transport") == "rtu":
        return f"serial {_real(given['serial'])} unit {given.get('device_id')}"
    if "host" not in given:
        return f"host {given.get('file', link)}"
    port = given.get("port")
    at = f" port {port}" if port is not None and port not in OWN_PORTS else ""
    return f"host {resolved(str(given['host']))}{at}"


@functools.cache
def resolved(host: str) -> str:
    """Return the numeric address of a host name, the first in order where it has several.

    A name that nobody knows stays as it is, in small letters: connecting will say so.
    """
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(host))
    try:
        found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return host.lower().rstrip(".")
    return min(str(address[0]) for *_, address in found)


def _real(path: str) -> str:
    """Return a serial port without the links that lead to it."""
    return os.path.realpath(path)


class OwnerLock:
    """The right to talk to one controller, machine-wide; the kernel takes it back at any end.

    ``before`` is what the last owner left behind, empty where it ended in order.
    """

    def __init__(self, address: str, cell: Path) -> None:
        self.address = address
        self._cell = cell
        self._fd: int | None = None
        self._name: socket.socket | None = None
        self.before: dict[str, Any] = {}

    def acquire(self) -> None:
        """Take the lock. Raises InputError where another daemon has it."""
        key = hashlib.sha256(self.address.encode()).hexdigest()[:16]
        path = runtime_folder() / f"{key}.lock"
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._claim_name(key)
        except OSError:
            owner = _read(fd)
            os.close(fd)
            who = f"process {owner['pid']}, {owner['cell']}" if "pid" in owner else "another user"
            raise InputError(
                f"{self._cell}: link: {self.address} is in use by another daemon ({who}), "
                "expected one owner per controller"
            ) from None
        self._fd, self.before = fd, _read(fd)
        self.note({})

    def _claim_name(self, key: str) -> None:
        """Take a name that daemons of other users see too, whatever their folder is."""
        if sys.platform.startswith("linux"):
            self._name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                self._name.bind(f"\0gapbridge-{key}")
            except OSError:
                self._name.close()
                raise

    def note(self, more: dict[str, Any]) -> None:
        """Leave word for whoever comes after an end that was not in order."""
        self._write(json.dumps({"pid": os.getpid(), "cell": str(self._cell), **more}))

    def _write(self, text: str) -> None:
        if self._fd is not None:
            data = text.encode()
            with contextlib.suppress(OSError):  # a full disk is no reason to stop an arm
                os.pwrite(self._fd, data, 0)
                os.ftruncate(self._fd, len(data))

    def release(self) -> None:
        """Give the lock back; the end was in order."""
        self._write("")
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
        if self._name is not None:
            self._name.close()
            self._name = None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def _read(fd: int) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError):
        found = json.loads(os.pread(fd, 65536, 0))
        if isinstance(found, dict):
            return found
    return {}
