"""Sockets that a library keeps to itself send at once all the same."""

from __future__ import annotations

import socket

from gapbridge.drivers.ur_rtde.command import send_at_once


def test_connections_of_this_process_send_at_once_and_stay_open() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as client,
        server.accept()[0] as end,
    ):
        assert not client.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert send_at_once() >= 2
        assert client.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        client.sendall(b"setpoint")
        assert end.recv(8) == b"setpoint"
