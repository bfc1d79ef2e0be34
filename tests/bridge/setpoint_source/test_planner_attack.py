"""A web page is no planner: what a browser, or anybody, posts to the feed moves nothing."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import struct
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run
from patience import PATIENCE
from ports import free_port

from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.setpoint_source import make_source
from gapbridge.drivers.clock import SYSTEM

TOKEN = "0d9b7a63c1f24e58b6a7d3c2e1f09485"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
LINES = 1000
WAY = 0.1  # rad that joint 1 would be moved by


class Target:
    """An armed daemon whose feed is a TCP port of loopback, and what became of its arm."""

    def __init__(self, robot: Robot, run: Run, port: int) -> None:
        self.robot, self.run, self.port = robot, run, port
        self.start_q = np.array(robot.settings.start_q)
        self._stood = robot.truth()["true_tcp"]

    def lines(self) -> bytes:
        """Return what moves joint 1, as a planner writes it, behind the right token."""
        ways = np.linspace(0.0, WAY, LINES)
        lines = [json.dumps({"q": (self.start_q + w * np.eye(6)[0]).tolist()}) for w in ways]
        return "\n".join([f"token {TOKEN}", *lines, ""]).encode()

    def assert_untouched(self) -> None:
        """Raise where the loop has begun to write, or the arm has moved."""
        events = self.run.daemon.events_since(0)
        assert not [e for e in events if e.get("to") == State.COMPENSATING.name]
        assert self.run.daemon.state == State.ARMED
        assert self.run.daemon.status()["link"]["written"] == 0
        assert self.robot.truth()["true_tcp"] == self._stood

    def arm(self) -> None:
        """Have a person arm it where a busy machine has ended that."""
        if self.run.daemon.state == State.OBSERVING:
            self.run.daemon.arm()
        self.run.wait(State.ARMED)

    def is_open_to_a_planner(self) -> bool:
        """Return whether a planner with the token moves the loop on: the attack had a target."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE) as link:
            link.sendall(f"token {TOKEN}\n".encode())
            until = time.monotonic() + PATIENCE
            while time.monotonic() < until:
                with contextlib.suppress(OSError):
                    link.sendall((json.dumps({"q": self.start_q.tolist()}) + "\n").encode())
                time.sleep(0.01)
                if self.run.daemon.state == State.COMPENSATING:
                    return True
        return False


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    folder, port = tmp_path_factory.mktemp("attacked"), free_port()
    token = folder / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    with Robot(folder) as robot:
        cell = robot.cell(
            ", state_timeout: 0.25",
            setpoints=f"{{source: tcp, token_file: token, port: {port}, timeout: 0.5}}",
        )
        with Run(cell, arm=True) as run:
            run.wait(State.ARMED)
            yield Target(robot, run, port)


def post(port: int, body: bytes, limit: float = 2.0) -> bytes:
    """Send an HTTP POST as it goes over the wire; returns the answer."""
    head = (
        f"POST / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://evil.example\r\n"
        f"Content-Type: text/plain\r\nContent-Length: {len(body)}\r\n\r\n"
    ).encode()
    found = b""
    with (
        contextlib.suppress(OSError),
        socket.create_connection(("127.0.0.1", port), timeout=limit) as link,
    ):
        for k in range(0, len(head + body), 1000):
            link.sendall((head + body)[k : k + 1000])
            time.sleep(0.002)
        while piece := link.recv(4096):
            found += piece
    return found


def test_a_posted_body_is_no_plc(tmp_path: Path) -> None:
    """A whole Modbus request as the body of an HTTP POST is not taken from behind the head."""
    settings = SetpointSettings(source="modbus", port=0, timeout=0.5)
    source = make_source(settings, 3, True, tmp_path, clock=SYSTEM)
    source.open()
    try:
        counts = [0, 7, *(0, 100) * 3]
        write = struct.pack(">BHHB", 16, 0, len(counts), 2 * len(counts))
        write += struct.pack(f">{len(counts)}H", *counts)
        frame = struct.pack(">HHHB", 1, 0, len(write) + 1, 1) + write
        port = source.port  # type: ignore[attr-defined]
        for pad in range(8):
            post(port, pad * b"\0" + 40 * frame, limit=0.5)
        time.sleep(0.2)
        assert source.first(np.zeros(3)) is None
        with socket.create_connection(
            ("127.0.0.1", port), timeout=PATIENCE
        ) as plc:  # it does listen
            plc.sendall(frame)
            assert plc.recv(100)
    finally:
        source.close()


@pytest.mark.realtime(limit=0.1)
def test_a_posted_body_is_no_plan(target: Target) -> None:
    target.arm()
    for _ in range(3):
        reply = post(target.port, target.lines())
        assert reply == b"" or reply.startswith(b"error: ")  # reset, or refused in one line
    target.run.cycle(150)
    target.assert_untouched()


class Page(BaseHTTPRequestHandler):
    """A stranger's page that posts to the port in its address, without asking to read."""

    body = b""

    def do_GET(self) -> None:
        text = f"""<script>
const [body, port] = [{json.dumps(self.body.decode())}, location.hash.slice(1)];
const ways = [0, 1, 2, 3, 4, 5].map(k => fetch(`http://127.0.0.1:${{port}}/${{k}}`,
  {{method: "POST", mode: "no-cors", body}}).then(() => "answered", () => "failed"));
Promise.all(ways).then(found => {{ document.title = found.join(); }});
</script>""".encode()
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.realtime(limit=0.1)
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_a_strangers_page_in_a_browser_is_no_planner(target: Target) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    Page.body = target.lines()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with playwright.sync_playwright() as started:
            browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            page = browser.new_page()
            page.set_default_timeout(1e3 * PATIENCE)
            sent: list[str] = []
            target.arm()  # the browser's start keeps a small machine busy
            page.on("request", lambda r: sent.append(r.method) if "127.0.0.1" in r.url else None)
            page.goto(f"http://localhost:{server.server_port}/#{target.port}")
            page.wait_for_function("document.title !== ''")
            browser.close()
    finally:
        server.shutdown()
        server.server_close()
    assert sent.count("POST") == 6  # the browser did send them
    target.run.cycle(150)
    target.assert_untouched()


def test_the_target_was_open_all_the_while(target: Target) -> None:
    """After the attacks a planner that knows the token is heard: they were refused, not lost."""
    target.arm()
    assert target.is_open_to_a_planner()
