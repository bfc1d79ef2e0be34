"""Runs in the place of the server that a PLC talks to; tries to write to all memory of the run."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from side_attacker import attack

from gapbridge.bridge.setpoint_source.plc_memory import PlcMemory


def main() -> None:
    order = json.loads(sys.stdin.readline())
    memory = PlcMemory(
        order["n"], tuple(order["memory"])
    )  # seals what is the server's own to write
    Path(os.environ["ATTACK_FOUND"]).write_text(json.dumps(attack(os.getppid())))
    print(json.dumps({"port": 1}), flush=True)
    sys.stdin.read()
    memory.close()


if __name__ == "__main__":
    main()
