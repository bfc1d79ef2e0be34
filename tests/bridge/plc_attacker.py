"""Runs in the place of the server that a PLC talks to; tries to write to all memory of the run."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from side_attacker import attack

from gapbridge.bridge.setpoint_source.modbus_page import PlcPage


def main() -> None:
    order = json.loads(sys.stdin.readline())
    page = PlcPage(order["n"], tuple(order["pages"]))  # seals what is the server's own to write
    Path(os.environ["ATTACK_FOUND"]).write_text(json.dumps(attack(os.getppid())))
    print(json.dumps({"port": 1}), flush=True)
    sys.stdin.read()
    page.close()


if __name__ == "__main__":
    main()
