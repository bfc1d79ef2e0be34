"""The server that a PLC talks to is on the network: taken over, it writes a setpoint, no more."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from patience import PATIENCE

LOOP = """
import sys
from pathlib import Path
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory, Commands
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.setpoint_source import modbus
from gapbridge.bridge.setpoint_source.source import SourceContext
from gapbridge.drivers.clock import SYSTEM

modbus.SERVER = "plc_attacker"
requests, cycles = CommandMemory(), SharedMemory(6, clock=SYSTEM)
commands = Commands(requests.fd)
settings = SetpointSettings(source="modbus", port=1)
context = SourceContext(settings, 6, False, Path(sys.argv[1]), 500.0, SYSTEM)
source = modbus.ModbusSource(context)
source.open()
try:
    print([command.name for command in commands.take()], cycles.state)
    print(requests.ask(Command.DISARM), [command.name for command in commands.take()])
finally:
    source.close()
"""


def test_the_server_of_a_plc_writes_to_no_memory_but_its_setpoint(tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    here = Path(__file__).parents[1]
    path = os.pathsep.join([str(here), str(here.parents[1])])
    done = subprocess.run(
        [sys.executable, "-c", LOOP, str(tmp_path)], capture_output=True, text=True,
        timeout=PATIENCE, env={**os.environ, "PYTHONPATH": path, "ATTACK_FOUND": str(found)},
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    attack = json.loads(found.read_text())
    assert attack["memories"] >= 4  # requests, cycles, the PLC's two, in both processes
    assert attack["written"] == []
    assert done.stdout.splitlines() == ["[] 0", "1 ['DISARM']"]
