"""A simulated controller: ``python -m gapbridge.drivers.simulated --arm ur10e``."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import threading
from dataclasses import replace

from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers.simulated.ur import settings as defaults
from gapbridge.drivers.simulated.ur.server import serve
from gapbridge.drivers.simulated.ur.settings import ServerSettings, from_json, simulated_cell


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m gapbridge.drivers.simulated", description=__doc__
    )
    parser.add_argument("--arm", default="ur10e", help="a built-in arm")
    parser.add_argument("--host", default="127.0.0.2", help="loopback address to bind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--tcp", type=float, nargs=6, default=(0.0,) * 6, metavar="V",
        help="TCP in the flange frame: x y z (m) and rotation vector (rad)",
    )  # fmt: skip
    parser.add_argument(
        "--payload", type=float, nargs=4, default=(0.0,) * 4, metavar="V",
        help="mass (kg) and centre of gravity in the flange frame (m)",
    )  # fmt: skip
    parser.add_argument("--rtde-port", type=int, default=defaults.RTDE_PORT)
    parser.add_argument("--dashboard-port", type=int, default=defaults.DASHBOARD_PORT)
    parser.add_argument("--script-port", type=int, default=defaults.SCRIPT_PORT)
    parser.add_argument("--primary-port", type=int, default=defaults.PRIMARY_PORT)
    parser.add_argument("--bench-port", type=int, default=defaults.BENCH_PORT)
    parser.add_argument(
        "--settings", choices=["-"], help="read all settings as JSON from stdin; end with stdin"
    )
    parser.add_argument("--log", default="WARNING", help="level of the log on stderr")
    return parser


def _settings(options: argparse.Namespace) -> ServerSettings:
    """Return the settings that the options ask for."""
    mass, *cog = options.payload
    cell = simulated_cell(
        options.arm,
        options.host,
        options.seed,
        tcp=tuple(options.tcp),
        payload_mass=mass,
        payload_cog=tuple(cog),
    )
    return replace(
        cell,
        rtde_port=options.rtde_port,
        dashboard_port=options.dashboard_port,
        script_port=options.script_port,
        bench_port=options.bench_port,
        primary_port=options.primary_port,
    )


def _wait_for_parent(stopped: list[int]) -> None:
    """Stop the server when the other end of stdin is gone."""
    sys.stdin.read()
    stopped.append(0)


def main(arguments: list[str] | None = None) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=options.log.upper(), stream=sys.stderr)
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, _: stopped.append(n))
    try:
        if options.settings:
            settings = from_json(json.loads(sys.stdin.readline()))
            threading.Thread(target=_wait_for_parent, args=(stopped,), daemon=True).start()
        else:
            settings = _settings(options)
        serve(settings, lambda: bool(stopped))
    except GapbridgeError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
