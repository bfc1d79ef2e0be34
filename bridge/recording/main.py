"""The recorder's process: ``python -m gapbridge.bridge.recording.main``, started by the daemon.

It reads along in the shared memory and can be stalled, killed and started anew without the loop
noticing. It outlives a daemon that was killed for as long as the loop still ramps out.
"""

from __future__ import annotations

import hashlib
import re
import signal
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from gapbridge.bridge.ipc.side_main import StartData, read_start_data
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.drivers.clock import SYSTEM

LOOK_EVERY = 0.1  # s
QUIET = 0.6  # s without a heartbeat of the loop after which a lost daemon's run is over
LONGEST_FAREWELL = 4.0  # s: then the process is ended by force
HIDDEN = "REDACTED"
_SECRET = re.compile(r"token|password|passwd|passphrase|secret|credential|api_?key", re.I)


def main() -> None:
    """Record until the daemon has ended."""
    # a service manager ends all processes at once; this one ends when it has everything
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    start = read_start_data()
    recorder = Recorder(
        start.settings.recording, start.session, start.memory, _configuration(start), start.emit
    )
    ended = _follow(start, recorder)
    if not ended:
        _record_remaining(start, recorder)
    recorder.close()


def _follow(start: StartData, recorder: Recorder) -> bool:
    """Record while the daemon is there; returns whether it ended in order."""
    ended = False
    while not start.events.closed:
        start.events.wait(LOOK_EVERY)
        SYSTEM.sleep(LOOK_EVERY / 2)  # events may come in crowds; cycles wait in the ring
        for event in start.events.poll():
            recorder.take(event)
            ended |= event.get("kind") == "ended"
            if event.get("kind") == "configuration":
                recorder.change_configuration(_configuration(start, event))
        recorder.step()
    return ended


def _record_remaining(start: StartData, recorder: Recorder) -> None:
    """Record on until the loop, which has lost its daemon, has stopped too."""
    until = SYSTEM.monotonic() + LONGEST_FAREWELL
    recorder.take(
        {"time": SYSTEM.time(), "kind": "recorder", "detail": "the daemon is gone without an end"}
    )
    while start.memory.silence < QUIET and SYSTEM.monotonic() < until:
        recorder.step()
        SYSTEM.sleep(LOOK_EVERY)


def _configuration(start: StartData, event: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return what the run is made of, without secrets."""
    cell = start.settings.cell
    content = _text_of(cell, (event or start.extra).get("text"))
    return {
        "program": f"gapbridge {_version()}",
        "cell": str(cell),
        "sha256": hashlib.sha256(content).hexdigest(),
        "text": redacted(content.decode("utf-8", "replace")),
        "joints": start.n,
        "driver": start.settings.link.driver,
    }


def _text_of(cell: Path, text: object) -> bytes:
    """Return the cell file's bytes: what the daemon has read, where it says so."""
    if isinstance(text, str):
        return text.encode()
    try:
        return cell.read_bytes()
    except OSError:
        return b""


def _version() -> str:
    try:
        return version("gapbridge")
    except PackageNotFoundError:
        return "not installed"


def redacted(text: str) -> str:
    """Return the text of a cell file without the values of keys that hold secrets.

    A key holds one where its name says so: token, password, secret, credential, api_key, ... A
    path to a file that holds the secret is no secret: keys that end in ``_file`` stay. Text that
    is no YAML is hidden as a whole.
    """
    try:
        root = yaml.compose(text, yaml.SafeLoader)
    except yaml.YAMLError:
        return HIDDEN
    spans: set[tuple[int, int]] = set()
    _find(root, spans, set())
    for start, end in sorted(spans, reverse=True):
        tail = text[start:end]
        text = text[:start] + HIDDEN + tail[len(tail.rstrip()) :] + text[end:]
    return text


def _find(node: yaml.Node | None, spans: set[tuple[int, int]], visited: set[int]) -> None:
    """Collect where the values of secret keys stand."""
    if not isinstance(node, yaml.CollectionNode) or id(node) in visited:
        return
    visited.add(id(node))
    for item in node.value:
        if isinstance(item, yaml.Node):
            _find(item, spans, visited)
            continue
        key, value = item
        name = str(key.value)
        if _SECRET.search(name) and not name.lower().endswith("_file"):
            spans.add((value.start_mark.index, value.end_mark.index))
        else:
            _find(value, spans, visited)


if __name__ == "__main__":
    main()
