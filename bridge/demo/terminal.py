"""The demo's result on the terminal: a table and bars."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gapbridge.bridge.demo.result import Result, visits_of_poses

WIDTH = 32  # characters of the longest bar
EIGHTHS = " ▏▎▍▌▋▊▉█"


def bar(share: float, width: int = WIDTH) -> str:
    """Return a bar for a share of 0 to 1, in eighths of a character."""
    eighths = round(min(max(share, 0.0), 1.0) * width * 8)
    full, rest = divmod(eighths, 8)
    return "█" * full + (EIGHTHS[rest] if rest else "" if full else EIGHTHS[1])


def show(result: Result, console: Console | None = None) -> None:
    """Print what the demo has shown."""
    console = console or Console()
    before, after = result.error_without * 1e3, result.error_with * 1e3
    table = Table(title="distance of the TCP from where it was wanted, mm", title_justify="left")
    for name in ("pose", "load", "without", "with", ""):
        table.add_column(name, justify="left" if name in ("load", "") else "right")
    longest = float(before.max())
    for row in visits_of_poses(result):
        bars = Text(bar(before[row].mean() / longest), style="red")
        bars.append("\n" + bar(after[row].mean() / longest), style="green")
        table.add_row(
            str(len(table.rows) + 1), result.loads[row[0]], f"{before[row].mean():.3f}",
            f"{after[row].mean():.3f}", bars,
        )  # fmt: skip
    console.print(table)
    figures = result.summary()
    errors, loop = figures["tcp_error_mm"], figures["loop"]
    ratio = errors["without"]["rms"] / errors["with"]["rms"]
    console.print(
        f"TCP error rms {errors['without']['rms']:.3f} mm without, {errors['with']['rms']:.3f} mm "
        f"with compensation: {ratio:.0f} times smaller; the arm repeats to "
        f"{figures['repeatability_mm']:.3f} mm"
    )
    if result.resolution.written:
        console.print(
            f"one count written is {figures['resolution_mm']:.3g} mm at the TCP, one count of the "
            f"joints as read {figures['reading_resolution_mm']:.3g} mm: {result.resolution.note}"
        )
    console.print(
        f"fitted on {figures['samples']} measured poses; {figures['setpoints_written']} setpoints "
        f"written at {loop['rate_hz']:.1f} Hz, {loop['missed']} of {loop['cycles']} cycles missed, "
        f"state behind a setpoint {loop['p99_us']:.0f} us old (p99)"
    )
