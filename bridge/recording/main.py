"""The recorder's process: ``python -m gapbridge.bridge.recording.main``, started by the daemon.

It reads the shared memory and can be stalled, killed and restarted without any effect on the loop.
If the daemon is killed, it goes on recording until the loop has ramped out.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import signal
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

import yaml

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.side_main import StartData, read_start_data
from gapbridge.bridge.recording.folder import hold
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.core.errors import LogError
from gapbridge.drivers.replay.settings import ReplaySettings

LOOK_EVERY = 0.1  # s
HEARTBEAT_TIMEOUT = 0.6  # s without a heartbeat of the loop: the run of a lost daemon is over
LONGEST_REMAINDER = 4.0  # s for which a recorder without a daemon goes on at most
HIDDEN = "REDACTED"
_SECRET = re.compile(r"token|password|passwd|passphrase|secret|credential|api_?key", re.I)


def main() -> None:
    """Record until the daemon has ended."""
    # a service manager signals all processes at once; this one ends after the last cycle
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    start = read_start_data()
    replayed: list[IO[bytes]] = []
    if isinstance(start.settings.link, ReplaySettings):
        with contextlib.suppress(OSError, LogError):  # the loop says so
            replayed = hold(start.settings.link.file)  # before the recorder makes room
    recorder = Recorder(
        start.settings.recording,
        start.session,
        start.memory,
        configuration_of(start, start.extra.get("text")),
        start.emit,
        start.clock,
    )
    ended = _follow(start, recorder)
    if not ended:
        _record_remaining(start, recorder)
    recorder.close()
    for file in replayed:
        file.close()


def _follow(start: StartData, recorder: Recorder) -> bool:
    """Record while the daemon runs; returns whether it sent its end event."""
    ended = False
    while not start.events.closed:
        start.events.wait(LOOK_EVERY)
        start.clock.sleep(LOOK_EVERY / 2)  # events come in bursts; cycles wait in the ring
        for event in start.events.poll():
            if event.get("kind") == EventKind.CELL:
                recorder.change_configuration(configuration_of(start, event["text"]))
                continue
            recorder.take(event)
            ended |= event.get("kind") == EventKind.ENDED
        recorder.step()
    return ended


def _record_remaining(start: StartData, recorder: Recorder) -> None:
    """Go on recording until the loop, which has lost its daemon, has stopped too."""
    until = start.clock.monotonic() + LONGEST_REMAINDER
    detail = "the daemon is gone without an end"
    recorder.take({"time": start.clock.time(), "kind": EventKind.RECORDER, "detail": detail})
    while start.memory.silence < HEARTBEAT_TIMEOUT and start.clock.monotonic() < until:
        recorder.step()
        start.clock.sleep(LOOK_EVERY)


def configuration_of(start: StartData, text: str | None) -> dict[str, Any]:
    """Return program, cell file and driver of the run, without secrets.

    ``text``: of the cell file, as the daemon has read it; None: as the disk has it.
    """
    cell = start.settings.cell
    content = _text_of(cell, text)
    return {
        "program": f"gapbridge {_version()}",
        "cell": str(cell),
        "sha256": hashlib.sha256(content).hexdigest(),
        "text": redacted(content.decode("utf-8", "replace")),
        "joints": start.n,
        "driver": start.settings.link.driver,
    }


def _text_of(cell: Path, text: str | None) -> bytes:
    """Return the cell file's bytes: those of ``text``, else the file's."""
    if text is not None:
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

    A key holds a secret if its name does: token, password, secret, credential, api_key, ... The
    path of a file is no secret: keys that end in ``_file`` stay. Text that is not YAML is hidden as
    a whole.
    """
    try:
        root = yaml.compose(text, yaml.SafeLoader)
    except yaml.YAMLError:
        return HIDDEN
    spans: set[tuple[int, int]] = set()
    _find_secrets(root, spans, set())
    for start, end in sorted(spans, reverse=True):
        tail = text[start:end]
        text = text[:start] + HIDDEN + tail[len(tail.rstrip()) :] + text[end:]
    return text


def _find_secrets(node: yaml.Node | None, spans: set[tuple[int, int]], visited: set[int]) -> None:
    """Collect the spans (start, end) of the values of secret keys."""
    if not isinstance(node, yaml.CollectionNode) or id(node) in visited:
        return
    visited.add(id(node))
    for item in node.value:
        if isinstance(item, yaml.Node):
            _find_secrets(item, spans, visited)
            continue
        key, value = item
        name = str(key.value)
        if _SECRET.search(name) and not name.lower().endswith("_file"):
            spans.add((value.start_mark.index, value.end_mark.index))
        else:
            _find_secrets(value, spans, visited)


if __name__ == "__main__":
    main()
