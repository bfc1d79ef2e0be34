"""What a UR controller reports about its arm: RTDE (TCP, payload) and the primary interface.

Reads only: no input is claimed, no program touched. Sources: Universal Robots, RTDE guide (port
30004), and the client interfaces' description of the primary interface (port 30001): packages of
int32 size and int8 type, robot states (16) of sub-packages, kinematics info (5) with the factory
calibration, configuration data (6) with joint limits and nominal DH rows; big-endian.

RTDE streams its samples, which therefore do not show their transit time: ``RoundTrip`` measures it
on a separate connection.
"""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gapbridge.core.arm import builtin_arm, builtin_names, builtin_rows
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, WriteError
from gapbridge.core.rotation import rotation_matrix, transform
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.controller_facts import ControllerFacts

RTDE, PRIMARY = 30004, 30001
N = 6
SAME = 1e-3  # m, rad: nominal DH rows of one model
TIMEOUT = 2.0  # s for each of the two
LONGEST = 1.0  # s that the answer of a round trip may take
TRIES = 5  # requests, of which the median is taken
ASK_EVERY = 0.2  # s between two requests while armed
STATE, KINEMATICS, CONFIGURATION = 16, 5, 6  # types of a package and its sub-packages
LARGEST = 1 << 20  # bytes of a package
_VERSION = struct.pack(">H", 2)  # of the protocol
_FIELDS = {
    "tcp_offset": 6, "payload": 1, "payload_cog": 3, "target_gravity": 3, "actual_q": 6,
}  # fmt: skip


@dataclass(frozen=True)
class PrimaryFacts:
    """What the primary interface reports: rows are (theta, a, d, alpha) of each joint."""

    calibrated: Array | None = None  # (6, 4) rad, m, m, rad
    nominal: Array | None = None  # (6, 4)
    limits: Array | None = None  # (6, 3): lower, upper (rad), velocity (rad/s)


def enquire(host: str, clock: Clock) -> ControllerFacts:
    """Return what a UR controller reports about its arm.

    Where its primary interface cannot be read, model, calibration and limits stay None. Raises
    LinkError where RTDE cannot.
    """
    try:
        version, fields = _rtde(host)
    except (OSError, EOFError, struct.error) as error:
        message = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise LinkError(f"{host}: found no answer on RTDE's port {RTDE}: {message}") from None
    try:
        primary = read_primary(host, clock)
    except (OSError, EOFError, struct.error):
        primary = PrimaryFacts()
    model = None if primary.nominal is None else model_of(primary.nominal)
    deltas = {}
    if model is not None and primary.calibrated is not None and primary.nominal is not None:
        apart = primary.calibrated - nominal_rows(model)
        deltas = {f"delta_{key}": apart[:, i].tolist()
                  for i, key in enumerate(("theta", "a", "d", "alpha"))}  # fmt: skip
    limits, tcp = primary.limits, fields.get("tcp_offset")
    return ControllerFacts(
        n=N,
        model=model,
        version=".".join(str(v) for v in version[:3]),
        arm=None if model is None else builtin_arm(model, deltas),
        calibration=deltas,
        tcp=None if tcp is None else transform(rotation_matrix(tcp[3:]), tcp[:3]),
        payload=None if "payload" not in fields else float(fields["payload"][0]),
        payload_cog=fields.get("payload_cog"),
        # UR's gravity is what holds the arm up: set_gravity([0, 0, 9.82]) where it stands upright
        gravity=None if "target_gravity" not in fields else -fields["target_gravity"],
        rate=500.0 if version[0] >= 5 else 125.0,
        lower=None if limits is None else limits[:, 0],
        upper=None if limits is None else limits[:, 1],
        velocity=None if limits is None else limits[:, 2],
        q=fields.get("actual_q"),
    )


def require_listening(host: str) -> None:
    """Raise LinkError if no server listens: ur_rtde would print messages instead."""
    try:
        socket.create_connection((host, RTDE), TIMEOUT).close()
    except OSError:
        raise LinkError(
            f"could not connect to {host}, port {RTDE}: is this the controller's address, and "
            "does it run?"
        ) from None


class RoundTrip:
    """Round trips of a request that changes nothing, on a connection of its own.

    It bounds the transit time of the samples, which come on another. The connection stays open, so
    that a round trip is measured again without waiting.
    """

    def __init__(self, host: str, clock: Clock) -> None:
        self._host, self._now = host, clock.monotonic
        self._link: socket.socket | None = None
        self._received = b""
        self._asked = -math.inf  # s, monotonic: when the last request was sent
        self._waits = False  # for its answer

    def measure(self) -> float:
        """Return the median round-trip time of some requests, s. Waits; connects anew.

        Raises WriteError where no answer comes.
        """
        self.close()
        times = []
        try:
            self._link = socket.create_connection((self._host, RTDE), LONGEST)
            self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for _ in range(TRIES):
                self._ask(self._link)
                while not self._is_answered(self._link):
                    pass
                times.append(self._now() - self._asked)
            self._link.setblocking(False)
        except (OSError, EOFError) as error:
            self.close()
            message = getattr(error, "strerror", None) or str(error)
            raise WriteError(
                f"{self._host}: found no answer on RTDE's port {RTDE}: {message}"
            ) from None
        return sorted(times)[TRIES // 2]

    def poll(self) -> float | None:
        """Return, once, the round-trip time of the last request, s, and ask again in time.

        Never waits; None: no answer yet, or the connection has ended: the next ``measure`` opens
        another.
        """
        if self._link is None:
            return None
        try:
            if not self._waits:
                if self._now() - self._asked >= ASK_EVERY:
                    self._ask(self._link)
            elif self._is_answered(self._link):
                return self._now() - self._asked
        except BlockingIOError:
            pass
        except (OSError, EOFError):
            self.close()
        return None

    def close(self) -> None:
        """Close the connection."""
        if self._link is not None:
            self._link.close()
        self._link, self._received, self._waits = None, b"", False

    def _ask(self, link: socket.socket) -> None:
        self._asked, self._waits = self._now(), True
        link.sendall(struct.pack(">HB", 3 + len(_VERSION), ord("V")) + _VERSION)

    def _is_answered(self, link: socket.socket) -> bool:
        """Read once and return whether the answer was among it; raises OSError, EOFError."""
        data = link.recv(4096)
        if not data:
            raise EOFError("the connection has ended")
        self._received += data
        while len(self._received) >= 3:
            size, kind = struct.unpack_from(">HB", self._received)
            if size < 3:
                raise EOFError(f"found a message of {size} bytes")
            if len(self._received) < size:
                break
            self._received = self._received[size:]
            if kind == ord("V"):
                self._waits = False
        return not self._waits


def nominal_rows(model: str) -> Array:
    """Return (6, 4) theta, a, d, alpha of a built-in arm."""
    rows = builtin_rows(model)["dh"]
    return np.array([[r.get("offset", 0.0), r["a"], r["d"], r["alpha"]] for r in rows], dtype=float)


def model_of(nominal: Array) -> str | None:
    """Return the built-in arm that has nominal rows (6, 4), or None."""
    for name in builtin_names():
        rows = nominal_rows(name)
        if rows.shape == nominal.shape and np.abs(rows - nominal).max() < SAME:
            return name
    return None


# -- RTDE ---------------------------------------------------------------------------------------


def _rtde(host: str) -> tuple[tuple[int, ...], dict[str, Array]]:
    """Return the controller's version and one sample of the fields that it has."""
    with socket.create_connection((host, RTDE), TIMEOUT) as link, link.makefile("rb") as answers:

        def ask(kind: str, payload: bytes = b"") -> bytes:
            link.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
            return _answer(answers, kind)

        ask("V", _VERSION)
        version = struct.unpack(">4I", ask("v")[:16])
        names = list(_FIELDS)
        for _ in range(2):
            types = ask("O", struct.pack(">d", 125.0) + ",".join(names).encode())[1:]
            kinds = types.decode("ascii", "replace").split(",")
            known = [n for n, k in zip(names, kinds, strict=False) if k != "NOT_FOUND"]
            if known == names:
                break
            names = known
        ask("S")
        body = _answer(answers, "U")[1:]
    values = np.array(struct.unpack(f">{len(body) // 8}d", body[: 8 * (len(body) // 8)]))
    if len(values) != sum(_FIELDS[n] for n in names) or not np.isfinite(values).all():
        raise EOFError(f"found {len(values)} numbers in a sample of {', '.join(names)}")
    fields, start = {}, 0
    for name in names:
        fields[name] = values[start : start + _FIELDS[name]]
        start += _FIELDS[name]
    return version, fields


def _answer(answers: Any, kind: str) -> bytes:
    while True:
        size, got = struct.unpack(">HB", _exactly(answers, 3))
        payload = _exactly(answers, size - 3)
        if got == ord(kind):
            return payload


def _exactly(stream: Any, count: int) -> bytes:
    data: bytes = stream.read(count) if count >= 0 else b""
    if len(data) < max(count, 0) or count < 0:
        raise EOFError("the connection was closed")
    return data


# -- the primary interface ----------------------------------------------------------------------


def read_primary(host: str, clock: Clock) -> PrimaryFacts:
    """Return geometry and limits from the primary interface.

    Raises OSError, EOFError where it cannot be read, struct.error where it is another thing.
    """
    until, facts = clock.monotonic() + TIMEOUT, PrimaryFacts()
    with socket.create_connection((host, PRIMARY), TIMEOUT) as link, link.makefile("rb") as stream:
        while clock.monotonic() < until:
            size, kind = struct.unpack(">ib", _exactly(stream, 5))
            if not 5 <= size <= LARGEST:
                raise EOFError(f"found a package of {size} bytes")
            body = _exactly(stream, size - 5)
            if kind != STATE:
                continue
            facts = _with_state(facts, body)
            if facts.calibrated is not None and facts.nominal is not None:
                return facts
    return facts


def _with_state(facts: PrimaryFacts, body: bytes) -> PrimaryFacts:
    calibrated, nominal, limits = facts.calibrated, facts.nominal, facts.limits
    for kind, part in _parts(body):
        if kind == KINEMATICS:
            # checksums, then theta, a, d, alpha
            calibrated = np.array(struct.unpack_from(">24d", part, 24)).reshape(4, 6).T
        elif kind == CONFIGURATION:
            bounds = np.array(struct.unpack_from(">12d", part, 0)).reshape(6, 2)
            fast = np.array(struct.unpack_from(">12d", part, 96)).reshape(6, 2)
            limits = np.column_stack([bounds, fast[:, 0]])
            # five lengths and speeds, then a, d, alpha, theta
            a, d, alpha, theta = np.array(struct.unpack_from(">24d", part, 232)).reshape(4, 6)
            nominal = np.column_stack([theta, a, d, alpha])
    return PrimaryFacts(calibrated, nominal, limits)


def _parts(body: bytes) -> Iterator[tuple[int, bytes]]:
    start = 0
    while start + 5 <= len(body):
        size, kind = struct.unpack_from(">IB", body, start)
        if size < 5 or start + size > len(body):
            raise struct.error(f"found a sub-package of {size} bytes")
        yield kind, body[start + 5 : start + size]
        start += size
