"""A whole daemon on a simulated robot, watched: page, metrics, log; what it listens on."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
from daemon_cell import Robot
from patience import wait_for
from watched_daemon import Watched, listening

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    with Robot(tmp_path_factory.mktemp("watched")) as found:
        yield found


@pytest.fixture
def daemon(robot: Robot) -> Iterator[Watched]:
    found = Watched(robot)
    try:
        found.wait("observing")
        yield found
    finally:
        found.end()


def test_the_daemon_is_watched_and_nothing_about_it_can_be_changed_from_the_network(
    daemon: Watched,
) -> None:
    # a stranger's scan: page and metrics on loopback, and not one port more
    assert listening(daemon.process.pid) == {
        ("127.0.0.1", daemon.web), ("127.0.0.1", daemon.metrics),
    }  # fmt: skip
    for path in ("arm", "disarm", "stop", "status", "session"):
        for method in ("POST", "PUT"):
            assert httpx.request(method, daemon.url + path).status_code == 405
    assert daemon.status()["now"]["state"] == "observing"

    daemon.arm()
    found = daemon.status()
    assert found["now"]["written"] > 20
    assert 60 < found["now"]["rate"] < 150
    assert set(found["status"]["sides"]) == {"recorder", "web", "metrics"}
    history = httpx.get(f"{daemon.url}history?seconds=2&points=100").json()
    column = {name: i for i, name in enumerate(history["columns"])}
    last = history["points"][-1]
    assert 1e-5 < np.linalg.norm(last[2:8]) < 0.02
    assert last[column["measured_fz"]] is not None
    assert last[column["predicted_fz"]] == pytest.approx(last[column["measured_fz"]], abs=5.0)
    text = httpx.get(f"http://127.0.0.1:{daemon.metrics}/metrics").text
    assert 'gapbridge_transitions_total{cause="writing",to="compensating"}' in text

    daemon.command("disarm")
    daemon.wait("observing")
    daemon.end()
    events = daemon.events()
    assert all({"time", "level", "event", "message"} <= set(event) for event in events)
    reported = [event["to"].lower() for event in events if event["event"] == "transition"]
    assert reported[0] == "observing"
    assert reported.index("armed") < reported.index("compensating")
    assert "robot:" not in daemon.log.read_text()  # the cell's own text is in no log


def test_page_and_metrics_die_and_come_back_and_the_loop_never_notices(daemon: Watched) -> None:
    before = daemon.status()
    loop = before["status"]["loop"]["pid"]
    for name in ("web", "metrics"):
        os.kill(before["status"]["sides"][name]["pid"], signal.SIGKILL)

    def back() -> bool:
        status = daemon.status().get("status") or {}
        sides = status.get("sides", {})
        return bool(sides) and all(sides[n]["restarts"] == 1 for n in ("web", "metrics"))

    wait_for(back, "page and metrics")
    after = daemon.status()
    assert after["status"]["loop"]["pid"] == loop
    assert after["status"]["loop"]["restarts"] == 0
    assert after["session"] == before["session"]
    expected = {("127.0.0.1", daemon.web), ("127.0.0.1", daemon.metrics)}
    wait_for(lambda: listening(daemon.process.pid) == expected, "both listening again")
