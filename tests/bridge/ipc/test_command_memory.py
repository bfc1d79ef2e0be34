"""Requests to the loop: none is lost, none overwrites another one, none can be forged."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from gapbridge.bridge.ipc.command_memory import Command, CommandMemory, Commands

ARM, DISARM, RAMP_OUT, STOP, _ = Command


@pytest.fixture
def memory() -> Iterator[CommandMemory]:
    found = CommandMemory()
    yield found
    found.close()


def test_each_request_is_taken_once_and_in_the_order_of_asking(memory: CommandMemory) -> None:
    loop = Commands(memory.fd)
    assert loop.take() == []
    memory.ask(ARM)
    assert loop.take() == [ARM]
    assert loop.take() == []
    memory.ask(DISARM)
    last = memory.ask(ARM)
    assert loop.take() == [DISARM, ARM]
    assert loop.last_taken == last == memory.last


@pytest.mark.parametrize("late", [DISARM, STOP])
def test_no_arming_pushes_a_stop_or_a_disarming_aside(memory: CommandMemory, late: Command) -> None:
    loop = Commands(memory.fd)
    memory.ask(ARM)
    memory.ask(late)
    memory.ask(ARM)
    assert late in loop.take()
    assert loop.stop == (late == STOP)
    assert loop.take() == []
    assert loop.stop == (late == STOP)


def test_an_arming_that_is_overtaken_is_void_and_a_disarming_never_is(
    memory: CommandMemory,
) -> None:
    loop = Commands(memory.fd)
    early, late = memory.number(), memory.number()
    memory.ask(DISARM, late)
    assert loop.take() == [DISARM]
    memory.ask(ARM, early)  # a thread that was slow to write what it had a number for
    assert loop.take() == []
    early, late = memory.number(), memory.number()
    memory.ask(ARM, late)
    assert loop.take() == [ARM]
    memory.ask(DISARM, early)
    assert loop.take() == [DISARM]


def test_what_was_asked_of_one_loop_is_not_the_next_ones(memory: CommandMemory) -> None:
    for command in Command:
        memory.ask(command)
    following = Commands(memory.fd, after=memory.number())
    assert following.take() == []
    assert not following.stop
    memory.ask(DISARM)
    assert following.take() == [DISARM]


def test_none_is_lost_however_close_they_come(memory: CommandMemory) -> None:
    """Four threads ask as fast as they can; the loop takes in a process of its own."""
    code = f"""
import sys
from gapbridge.bridge.ipc.command_memory import Command, Commands
commands, counts = Commands({memory.fd}), dict.fromkeys(Command, 0)
print("there", flush=True)
last = dict.fromkeys(Command, 0)
while not commands.stop:
    for command in commands.take():
        counts[command] += 1
        last[command] = commands._taken_numbers[command]
print(*(last[c] for c in list(Command)[:4]), counts[Command.DISARM])
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], pass_fds=[memory.fd], stdout=subprocess.PIPE, text=True
    ) as loop:
        assert loop.stdout is not None
        loop.stdout.readline()

        def ask(command: Command) -> int:
            return [memory.ask(command) for _ in range(20_000)][-1]

        with ThreadPoolExecutor(4) as pool:
            asked = list(pool.map(ask, [ARM, DISARM, RAMP_OUT, ARM]))
        stop = memory.ask(STOP)
        for _ in range(50):
            memory.ask(ARM)  # right behind it
        *last, taken = map(int, loop.stdout.read().split())
    assert last[1:3] == asked[1:3]
    assert last[3] == stop
    assert taken > 1


def test_nobody_but_the_daemon_can_write_to_it(memory: CommandMemory) -> None:
    memory.ask(DISARM)
    ways = [memory.fd, os.open(f"/proc/self/fd/{memory.fd}", os.O_RDWR)]
    for fd in ways:
        with pytest.raises(PermissionError):
            mmap.mmap(fd, 4096)
        with pytest.raises(PermissionError):
            os.pwrite(fd, (99).to_bytes(8, "little"), 8 * ARM)
        with pytest.raises(PermissionError):
            os.ftruncate(fd, 0)
    os.close(ways[1])
    loop = Commands(memory.fd)
    with pytest.raises(TypeError):
        loop._map[8] = 1
    assert loop.take() == [DISARM]


def test_a_heartbeat_is_no_request(memory: CommandMemory) -> None:
    loop = Commands(memory.fd)
    assert loop.beats == 0
    memory.ask(ARM)
    for count in (1, 2):
        memory.beat()
        assert loop.beats == count
    assert loop.take() == [ARM]
    memory.beat()
    assert loop.take() == []
