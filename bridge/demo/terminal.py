"""The demo's result on the terminal: a table with bars."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gapbridge.bridge.demo.result import Result, visits_of_poses
from gapbridge.bridge.document.numbers import unit_of

WIDTH, NARROW = 32, 8  # characters of the longest bar, on a wide and on a narrow terminal
OTHER_COLUMNS = 68  # characters of a row without its bars
EIGHTHS = " ▏▎▍▌▋▊▉█"


def bar(share: float, width: int = WIDTH) -> str:
    """Return a bar for a share of 0 to 1, in eighths of a character."""
    eighths = round(min(max(share, 0.0), 1.0) * width * 8)
    full, rest = divmod(eighths, 8)
    return "█" * full + (EIGHTHS[rest] if rest else "" if full else EIGHTHS[1])


def show(result: Result, console: Console | None = None) -> None:
    """Print the result of the demo."""
    console = console or Console()
    rounds = [(name, error * 1e3) for name, error in result.rounds]
    before = rounds[0][1]
    table = Table(title="distance of the TCP from the intended position, mm", title_justify="left")
    names = [name for name, _ in rounds]
    for name in ("pose", "load", *names, ""):
        table.add_column(name, justify="left" if name in ("load", "") else "right")
    longest = float(before.max())
    width = min(max(console.width - OTHER_COLUMNS, NARROW), WIDTH)
    for row in visits_of_poses(result):
        means = [float(values[row].mean()) for _, values in rounds]
        styles = ("red", "yellow", "green") if len(means) == 3 else ("red", "green")
        bars = Text()
        for k, (mean, style) in enumerate(zip(means, styles, strict=True)):
            bars.append(("\n" if k else "") + bar(mean / longest, width), style=style)
        table.add_row(
            str(len(table.rows) + 1), result.loads[row[0]], *(f"{m:.3f}" for m in means), bars
        )
    console.print(table)
    figures = result.summary()
    errors, loop = figures["tcp_error_mm"], figures["loop"]
    ratio = errors["without"]["rms"] / errors["with"]["rms"]
    console.print(
        f"TCP error rms {errors['without']['rms']:.3f} mm without, {errors['with']['rms']:.3f} mm "
        f"with compensation: {ratio:.0f} times smaller; "
        f"repeatability of the arm {figures['repeatability_mm']:.3f} mm"
    )
    if (joints := figures["joint_error_mrad"]) is not None:
        plain, live = joints["without"], joints["with"]
        console.print(
            f"joint error at rest {plain['rms']:.3f} mrad rms without compensation (at most "
            f"{plain['max']:.3f}), {live['rms']:.4f} mrad with (at most {live['max']:.4f}): "
            f"{plain['rms'] / live['rms']:.0f} times smaller"
        )
    for line in truth_lines(result):
        console.print(line, highlight=False)
    if result.resolution.written:
        console.print(
            f"resolution at the TCP: {figures['resolution_mm']:.3g} mm as written, "
            f"{figures['reading_resolution_mm']:.3g} mm as read; {result.resolution.note}"
        )
    console.print(
        f"fitted on {figures['samples']} measured poses; {figures['setpoints_written']} setpoints "
        f"written at {loop['rate_hz']:.1f} Hz, {loop['missed']} of {loop['cycles']} cycles missed, "
        f"age of the state behind a setpoint {loop['p99_us']:.0f} us (p99)"
    )


def truth_lines(result: Result) -> list[str]:
    """Return a line per hidden parameter with its estimate; empty where nothing was hidden."""
    if result.hidden is None:
        return []
    fitted = result.summary()["tcp_error_mm"]["fitted"]["rms"]
    lines = [f"the fitted flexibilities alone left {fitted:.3f} mm: {result.hidden.description}"]
    return lines + [
        f"  {name}: true {true}, {f'estimated {estimate}' if estimate else 'not found'}"
        for name, true, estimate in truth_rows(result)
    ]


def truth_rows(result: Result) -> list[tuple[str, str, str]]:
    """Return name, true value and estimate (empty: not found) of each hidden parameter."""
    estimates = {
        name: (value, std, unit) for c in result.causes for name, value, std, unit in c.parameters
    }
    rows = []
    for name, true in ({} if result.hidden is None else result.hidden.truth).items():
        if name not in estimates:
            rows.append((name, f"{true:+.3g}", ""))
            continue
        value, std, unit = estimates[name]
        unit, times = unit_of(unit)
        estimate = f"{value * times:+.3g} ± {std * times:.1g} {unit}"
        rows.append((name, f"{true * times:+.3g} {unit}", estimate))
    return rows
