"""Metrics over the wire: read by Prometheus' own parser, counted from cycles and events."""

import os
import re
import shutil
import subprocess
import time
from contextlib import closing, contextmanager

import httpx
import numpy as np
import pytest
from patience import PATIENCE, wait_for
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as strict_parser
from prometheus_client.parser import text_string_to_metric_families
from watched_feed import Feed

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.metrics.main import Buckets, Counts, Families, recording_lag
from gapbridge.drivers.clock import SYSTEM


@pytest.fixture(scope="module")
def feed(tmp_path_factory):
    with Feed(tmp_path_factory.mktemp("metrics"), "metrics") as feed:
        feed.wait("metrics")
        yield feed


def families(feed):
    text = feed.wait("metrics").text
    return {f.name: f for f in text_string_to_metric_families(text)}


def value(found, family, name=None, **labels):
    for sample in found[family].samples:
        if sample.name == (name or sample.name) and labels.items() <= sample.labels.items():
            return sample.value
    raise AssertionError(f"{family} {labels}: not among {found[family].samples}")


def test_every_name_and_unit_follows_the_conventions(feed):
    answer = feed.wait("metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    found = families(feed)
    assert len(found) > 20
    for name, family in found.items():
        assert re.fullmatch(r"gapbridge_[a-z][a-z0-9_]*", name), name
        assert family.documentation.endswith("."), name
        assert family.type in ("counter", "gauge", "histogram"), name
        if family.type == "counter":
            assert all(s.name.endswith(("_total", "_created")) for s in family.samples), name
        if family.type == "histogram":
            assert name.endswith("_seconds")
        assert not re.search(r"_(ms|us|mm|s|hz)$", name), name


def test_the_state_is_one_of_six_and_changes(feed):
    feed.change(State.COMPENSATING, "writing")
    wait_for(
        lambda: value(families(feed), "gapbridge_state", state="compensating") == 1.0, "the state"
    )
    states = families(feed)["gapbridge_state"].samples
    assert len(states) == len(State)
    assert sum(s.value for s in states) == 1.0
    feed.change(State.OBSERVING, "disarm")


def test_cycles_are_counted_as_the_loop_makes_them_and_none_is_lost(feed):
    made = feed.memory.written + 100  # some from now on
    wait_for(lambda: value(families(feed), "gapbridge_cycles") >= made, "the cycles")
    found = families(feed)
    assert value(found, "gapbridge_cycles") <= feed.memory.written
    assert value(found, "gapbridge_uncounted_cycles") == 0
    count = value(found, "gapbridge_loop_duration_seconds", "gapbridge_loop_duration_seconds_count")
    assert count == value(found, "gapbridge_cycles")
    age = value(
        found, "gapbridge_state_age_seconds", "gapbridge_state_age_seconds_bucket", le="0.008"
    )
    assert 0 < age <= count
    length = np.hypot.reduce([value(found, "gapbridge_offset_meters", axis=a) for a in "xyz"])
    assert 0.5e-3 < length < value(found, "gapbridge_offset_limit_meters")


def _counted(feed):
    """Return cycles that the recorder lost, the loop's restarts, and torn samples."""
    found = families(feed)
    torn = [s.value for s in found["gapbridge_dropped_samples"].samples
            if s.labels.get("reason") == "torn"]  # fmt: skip
    return (
        value(found, "gapbridge_recorder_lost_cycles"),
        value(found, "gapbridge_process_restarts", process="loop"),
        sum(torn),
    )


def test_faults_transitions_restarts_and_drops_are_separated(feed):
    before = families(feed)["gapbridge_faults"].samples
    assert all(s.labels["cause"] != "write failed" for s in before)
    feed.restarts = 3
    feed.counts = {"dropped_torn": 4, "stale": 2}
    feed.change(State.FAULT, "write failed", "the controller refused")
    feed.change(State.OBSERVING, "acknowledged")
    feed.emit(kind="recorder", detail="recording paused: disk full", paused="disk full")
    feed.emit(kind="recorder", detail="5 cycles lost", lost=5, paused="disk full")
    wait_for(lambda: _counted(feed) == (5, 3, 4), "the events and the counts")
    found = families(feed)
    assert value(found, "gapbridge_faults", cause="write failed") == 1
    assert value(found, "gapbridge_transitions", to="fault", cause="write failed") == 1
    assert value(found, "gapbridge_process_up", process="recorder") == 1
    assert value(found, "gapbridge_incidents", kind="stale") == 2
    assert value(found, "gapbridge_recorder_paused") == 1


def _limit_is(feed, limit):
    try:
        return value(families(feed), "gapbridge_offset_limit_meters") == limit
    except httpx.TransportError:
        return False


def test_a_cell_that_was_read_again_gives_its_limits(feed):
    assert value(families(feed), "gapbridge_offset_limit_meters") == 0.01
    feed.change_cell("limits: {offset: 0.004}\n")
    until = time.monotonic() + PATIENCE
    while value(families(feed), "gapbridge_offset_limit_meters") != 0.004:
        assert time.monotonic() < until
        time.sleep(0.1)
    os.kill(feed.side.pid, 9)  # a process started anew, with the first order, hears of it too
    until = time.monotonic() + PATIENCE
    while feed.side.restarts == 0 or not _limit_is(feed, 0.004):
        feed.side.check()
        assert time.monotonic() < until
        time.sleep(0.1)
    # a file that the daemon did not take changes nothing
    feed.change_cell("limits: {offset: 0.007}\n", ok=False)
    feed.change(State.OBSERVING, "afterwards")
    wait_for(lambda: "afterwards" in feed.wait("metrics").text, "the event after it")
    assert value(families(feed), "gapbridge_offset_limit_meters") == 0.004


def test_the_recording_is_late_although_another_run_of_the_same_second_is_written(tmp_path):
    run = tmp_path / "run-20260102-030405"
    for name, changed in (("-001", 100.0), ("-1000", 300.0), ("-999", 200.0), ("-2-001", 900.0)):
        path = tmp_path / f"{run.name}{name}.mcap"
        path.touch()
        os.utime(path, (changed, changed))
    assert recording_lag(str(run), 1000.0) == 700.0
    assert recording_lag(f"{run}-2", 1000.0) == 100.0
    assert recording_lag(f"{run}-3", 1000.0) is None
    assert recording_lag(None, 1000.0) is None


def test_nothing_else_is_served(feed):
    for path in ("", "status", "events", "metrics/", "favicon.ico"):
        assert httpx.get(feed.url + path).status_code in (307, 404)
    assert httpx.post(feed.url + "metrics").status_code == 405


def test_a_histogram_is_cumulative_and_ends_with_all_values():
    buckets = Buckets((0.001, 0.01))
    buckets.add(np.array([0.0005, 0.001, 0.005, 7.0, np.nan]))
    assert buckets.cumulative() == [("0.001", 2.0), ("0.01", 3.0), ("+Inf", 4.0)]
    assert buckets.sum == pytest.approx(7.0065)


@contextmanager
def _alone(cell):
    """Yield counts without a process of their own, and a function that returns their scrape."""
    settings = DaemonSettings.model_validate(
        {"cell": cell, "link": {"driver": "ur_rtde", "host": "127.0.0.2"}}
    )
    registry = CollectorRegistry(auto_describe=False)
    with closing(SharedMemory(6, clock=SYSTEM)) as memory:
        counts = Counts(memory, settings, SYSTEM)
        registry.register(Families("run", counts, {}))
        yield counts, lambda: generate_latest(registry).decode()


def test_a_cell_whose_name_is_no_text_is_counted_too():
    with _alone(os.fsdecode(b"zelle_\xfc.yaml")) as (_, scraped):
        assert 'cell="zelle_\\\\udcfc"' in scraped()


def test_a_loop_that_has_ended_is_disconnected_whatever_its_memory_says():
    with _alone("cell.yaml") as (counts, scraped):
        counts.memory.note_state(State.COMPENSATING)
        for named, state in (
            ("compensating", "compensating"), ("disconnected", "disconnected"),
            ("compiling the model", "disconnected"), ("compensating", "compensating"),
        ):  # fmt: skip
            counts.update([{"kind": "status", "state": named}])
            assert f'gapbridge_state{{state="{state}"}} 1.0' in scraped()


def test_the_names_are_also_good_openmetrics(feed):
    from prometheus_client.openmetrics.exposition import generate_latest

    class Again:
        def collect(self):
            return list(text_string_to_metric_families(feed.wait("metrics").text))

    registry = CollectorRegistry(auto_describe=False)
    registry.register(Again())
    assert len(list(strict_parser(generate_latest(registry).decode()))) > 20


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed")
def test_promtool_has_nothing_to_say(feed):
    text = feed.wait("metrics").text
    found = subprocess.run(
        ["promtool", "check", "metrics"], input=text, capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout + found.stderr) == (0, "")
