"""One owner per controller, and nothing to tidy after a crash."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from daemon_cell import Robot, Run, gapbridge
from link_settings import link_settings
from patience import PATIENCE, wait_for

from gapbridge.bridge.cell.runtime_folder import runtime_folder, state_folder
from gapbridge.bridge.daemon.owner_lock import OwnerLock
from gapbridge.bridge.ipc.control_client import ask
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.controller_address import address_of

pytestmark = pytest.mark.usefixtures("runtime")


CELL = Path("cell.yaml")
HOLD = """
import sys, time
from pathlib import Path
from gapbridge.bridge.daemon.owner_lock import OwnerLock
OwnerLock({address!r}, Path("first.yaml")).acquire()
print("held", flush=True)
time.sleep(1000)
"""


def at(host: int) -> str:
    """Return an address that no other process of the tests has, in another checkout either."""
    return f"host 192.0.2.{host} of {os.getpid()}"


def test_a_second_owner_is_refused_in_one_line_and_the_kernel_frees_the_lock() -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD.format(address=at(7))], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(InputError) as reported:
        OwnerLock(at(7), CELL).acquire()
    arguments = str(reported.value)
    assert "\n" not in arguments
    assert f"cell.yaml: link: {at(7)} is in use by another daemon" in arguments
    assert f"process {holder.pid}, first.yaml" in arguments
    OwnerLock(at(8), CELL).acquire()
    holder.kill()
    holder.wait()
    with OwnerLock(at(7), CELL) as lock:
        assert lock.before["pid"] == holder.pid  # it did not end in order
    with OwnerLock(at(7), CELL) as lock:
        assert lock.before == {}


def test_what_was_latched_outlives_an_owner_that_dies_and_the_next_one() -> None:
    first = OwnerLock(at(9), CELL)
    first.acquire()
    first.note({"latched": "robot not ready: protective stop"})
    _let_go_as_the_kernel_does(first)
    second = OwnerLock(at(9), CELL)
    second.acquire()  # dies before it says anything
    _let_go_as_the_kernel_does(second)
    with OwnerLock(at(9), CELL) as lock:
        assert lock.before["latched"] == "robot not ready: protective stop"
    with OwnerLock(at(9), CELL) as lock:
        assert lock.before == {}


def test_an_owner_that_died_while_it_wrote_a_shorter_note_did_not_end_in_order() -> None:
    first = OwnerLock(at(10), CELL)
    first.acquire()
    first.note({"latched": 100 * "x"})
    assert first._fd is not None
    os.pwrite(first._fd, b'{"pid": 7}\n', 0)  # and the rest was not cut off any more
    _let_go_as_the_kernel_does(first)
    with OwnerLock(at(10), CELL) as lock:
        assert lock.before == {"pid": 7}


def test_an_owner_that_fails_did_not_end_in_order() -> None:
    with pytest.raises(RuntimeError):
        _own(at(13), "robot not ready: protective stop", RuntimeError())
    assert list(state_folder().glob("*.running"))
    with OwnerLock(at(13), CELL) as lock:
        assert lock.before["latched"] == "robot not ready: protective stop"
        assert "did not end in order" in lock.disorder


@pytest.mark.parametrize("error", [InputError, LinkError])
def test_a_run_that_was_refused_at_its_start_is_as_if_there_had_been_none(
    error: type[Exception],
) -> None:
    with pytest.raises(error):
        _own(at(14), "", error("refused"))
    assert not list(state_folder().glob("*.running"))
    with pytest.raises(RuntimeError):
        _own(at(14), "zero moved", RuntimeError())
    for _ in range(2):  # the robot is off; whoever starts it again still learns of the first
        with pytest.raises(error):
            _own(at(14), "", error("refused"))
    assert list(state_folder().glob("*.running"))
    with OwnerLock(at(14), CELL) as lock:
        assert lock.before["latched"] == "zero moved"


def _own(address: str, latched: str, error: Exception) -> None:
    with OwnerLock(address, CELL) as lock:
        lock.note_latched(latched)
        raise error


def _let_go_as_the_kernel_does(lock: OwnerLock) -> None:
    assert lock._fd is not None
    os.close(lock._fd)
    if lock._name is not None:
        lock._name.close()


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ({"host": "10.0.0.5"}, {"host": "10.0.0.5", "rate": 125.0}, True),
        ({"host": "10.0.0.5"}, {"driver": "modbus", "profile": "ur", "host": "10.0.0.5"}, True),
        ({"host": "10.0.0.5"}, {"host": "10.0.0.6"}, False),
        ({"host": "Robot"}, {"host": "robot"}, True),
        ({"host": "localhost"}, {"host": "127.0.0.1"}, True),
        (
            {"driver": "modbus", "profile": "ur", "host": "10.0.0.5", "port": 5021},
            {"driver": "modbus", "profile": "ur", "host": "10.0.0.5", "port": 5022},
            False,
        ),
        (
            {"driver": "modbus", "profile": "ur", "host": "10.0.0.5", "port": 502},
            {"host": "10.0.0.5"},
            True,
        ),
        (
            {"driver": "can", "profile": "piper", "interface": "socketcan", "channel": "can0"},
            {"driver": "can", "profile": "piper", "interface": "socketcan", "channel": "can1"},
            False,
        ),
    ],
)
def test_the_same_controller_is_known_by_its_address(
    one: dict[str, Any], other: dict[str, Any], same: bool
) -> None:
    found = address_of(link_settings(**one)) == address_of(link_settings(**other))
    assert found == same


@pytest.mark.slow
def test_two_daemons_on_one_robot_the_second_leaves_with_two(robot: Robot) -> None:
    cell = robot.cell()
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        other = robot.folder / "other.yaml"
        other.write_text(cell.read_text())
        second = gapbridge("run", other, folder=robot.folder)
        out, err = second.communicate(timeout=PATIENCE)
        assert second.returncode == 2
        assert out == ""
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert "in use by another daemon" in err
        assert str(cell) in err
        run.cycle(100)
        assert run.daemon.state == State.OBSERVING
        assert run.end().restarts == 0


@pytest.mark.slow
@pytest.mark.parametrize("power_failure", [False, True])
def test_after_kill_nine_the_next_start_works_and_does_not_arm_by_itself(
    robot: Robot, power_failure: bool
) -> None:
    cell = robot.cell(setpoints="{arm: true}")
    first = gapbridge("run", cell, folder=robot.folder)
    assert first.stdout is not None
    while "compensating" not in first.stdout.readline():
        assert first.poll() is None
    loop = ask(cell, "status")["loop"]["pid"]
    sides = [side["pid"] for side in ask(cell, "status")["sides"].values()]
    first.send_signal(signal.SIGKILL)
    first.wait()
    for pid in [loop, *sides]:
        wait_for(lambda pid=pid: not alive(pid), f"the end of {pid}")
    if power_failure:  # empties the runtime folder
        for path in runtime_folder().iterdir():
            path.unlink()
    second = gapbridge("run", cell, "--duration", "2", folder=robot.folder)
    out, err = second.communicate(timeout=PATIENCE)
    assert err == ""
    assert "did not end in order: not arming by itself" in out
    assert "compensating" not in out
    third = gapbridge("run", cell, "--duration", "5", folder=robot.folder)
    assert "compensating" in third.communicate(timeout=PATIENCE)[0]  # the second ended in order


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_lock_shows_who_holds_it(tmp_path: Path) -> None:
    with OwnerLock(at(9), CELL):
        (path,) = (tmp_path / "gapbridge").glob("*.lock")
        assert json.loads(path.read_text())["cell"] == "cell.yaml"
        assert path.stat().st_mode & 0o777 == 0o600


def test_a_run_that_a_power_failure_ended_is_known_though_the_runtime_folder_is_empty() -> None:
    with OwnerLock(at(10), CELL) as lock:
        assert lock.before == {}
    lock = OwnerLock(at(10), CELL)
    lock.acquire()  # and no release
    assert lock.before == {}
    lock._name.close()
    for path in runtime_folder().glob("*.lock"):
        path.unlink()
    with OwnerLock(at(10), CELL) as after:
        assert after.before
        assert after.problem == ""
    assert not list(state_folder().glob("*.running"))
    with OwnerLock(at(10), CELL) as next_one:
        assert next_one.before == {}


@pytest.mark.parametrize("garbage", [b"", b"\0" * 100, b"\xff{"])
def test_whatever_is_in_the_mark_of_a_run_it_was_a_run(garbage: bytes) -> None:
    with OwnerLock(at(11), CELL):
        (mark,) = state_folder().glob("*.running")
    mark.write_bytes(garbage)
    with OwnerLock(at(11), CELL) as lock:
        assert lock.before


def test_without_a_state_folder_it_is_said_that_nothing_is_known_of_the_run_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with OwnerLock(at(12), CELL) as lock:
        assert "expected a folder to keep state in" in lock.problem
