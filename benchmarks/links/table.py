"""The links that are measured, and a line of the table for each."""

from __future__ import annotations

from typing import Any

from benchmarks.links import can_piper, canopen_drives
from benchmarks.links.case import LinkCase
from benchmarks.links.modbus_tcp import ModbusTcpCase
from benchmarks.links.serving import HubCase, VirtualCase
from benchmarks.links.ur_rtde import UrOffsetCase, UrServoCase

PIPER_LIBRARY = "python-can + cantools"
CASES: tuple[LinkCase, ...] = (
    UrOffsetCase(),
    UrServoCase(),
    ModbusTcpCase(),
    HubCase("can piper (socketcand)", PIPER_LIBRARY, can_piper.HUB, can_piper.armed),
    VirtualCase("can piper (virtual)", PIPER_LIBRARY, can_piper.VIRTUAL, can_piper.armed),
    HubCase("canopen lwa4p (socketcand)", "canopen", canopen_drives.HUB, canopen_drives.armed),
    VirtualCase("canopen lwa4p (virtual)", "canopen", canopen_drives.VIRTUAL, canopen_drives.armed),
)


def title() -> str:
    """Return the head of the table, Markdown."""
    return (
        "| link | beside | CPU us: ours | library | ratio | without compensation | wall us: ours "
        "| library | ratio | ours: read + compensate + write |\n" + "| --- " * 10 + "|"
    )


def line(found: dict[str, Any]) -> str:
    """Return one link's line, Markdown: medians (quartiles; ratios: and of minima)."""
    ours, library, ratio = found["ours"], found["library"], found["ratio"]
    parts = " + ".join(f"{us:.0f}" for us in ours["parts_us"].values())
    cells = [
        found["link"], found["compared_with"],
        _spread(ours["cpu_us"]), _spread(library["cpu_us"]), _ratio(ratio["cpu"]),
        _ratio(ratio["cpu_link"]),
        _spread(ours["wall_us"]), _spread(library["wall_us"]), _ratio(ratio["wall"]), parts,
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _spread(us: dict[str, float]) -> str:
    return f"{us['p50']:.0f} ({us['p25']:.0f}-{us['p75']:.0f})"


def _ratio(found: dict[str, float]) -> str:
    spread = f"{found['pairs_p25']:.2f}-{found['pairs_p75']:.2f}"
    return f"{found['median']:.2f} ({spread}; {found['min']:.2f})"
