"""An independent RTDE client on a raw socket, both protocol versions, for tests."""

from __future__ import annotations

import socket
import struct
from typing import Any

from patience import PATIENCE

FORMS = {
    "DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I",
    "UINT64": "Q", "UINT8": "B", "BOOL": "?", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip


class RtdeClient:
    def __init__(self, host: str, version: int = 2) -> None:
        self.sock = socket.create_connection((host, 30004), timeout=PATIENCE)
        self.version = version
        self.names: list[str] = []
        self.form = ""
        self.counts: list[int] = []
        if version == 2:
            assert self.ask("V", struct.pack(">H", 2)) == b"\x01"

    def send(self, kind: str, payload: bytes = b"") -> None:
        self.sock.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def receive(self) -> tuple[str, bytes]:
        size, kind = struct.unpack(">HB", self._exactly(3))
        return chr(kind), self._exactly(size - 3)

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self.sock.recv(count - len(data))
            if not more:
                raise EOFError
            data += more
        return data

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Send a request and return its reply; data packets in between are passed over."""
        self.send(kind, payload)
        while True:
            got, body = self.receive()
            if got == kind:
                return body

    def outputs(self, names: str, frequency: float = 500.0) -> list[str]:
        head = struct.pack(">d", frequency) if self.version == 2 else b""
        body = self.ask("O", head + names.encode())
        types = body[1 if self.version == 2 else 0 :].decode().split(",")
        self.names = [n for n in names.split(",") if n]
        if "NOT_FOUND" not in types:
            forms = [FORMS[t] for t in types]
            self.form = ">" + "".join(forms)
            self.counts = [int(f[:-1] or 1) for f in forms]
        return types

    def inputs(self, names: str) -> tuple[int, list[str]]:
        body = self.ask("I", names.encode())
        return body[0], body[1:].decode().split(",")

    def start(self) -> bool:
        return self.ask("S") == b"\x01"

    def sample(self) -> dict[str, Any]:
        while True:
            kind, body = self.receive()
            if kind != "U":
                continue
            if self.version == 2:
                assert body[0] == 1
                body = body[1:]
            flat = struct.unpack(self.form, body)
            found, at = {}, 0
            for name, count in zip(self.names, self.counts, strict=True):
                found[name] = flat[at] if count == 1 else list(flat[at : at + count])
                at += count
            return found

    def write(self, recipe: int, form: str, *values: Any) -> None:
        self.send("U", bytes([recipe]) + struct.pack(">" + form, *values))

    def close(self) -> None:
        self.sock.close()
