"""report.html of a demo run: one file that opens offline."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from gapbridge.bridge.demo.picture import AMBER, GREEN, RED, picture
from gapbridge.bridge.demo.result import Result
from gapbridge.bridge.demo.terminal import truth_lines

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1f2933; max-width: 980px; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem; text-align: right; }
th { border-bottom: 1px solid #9aa5b1; } .figures td:first-child { text-align: left; }
svg { max-width: 100%; height: auto; }
pre { background: #f5f7fa; padding: 1rem; white-space: pre-wrap; }
"""


def page(result: Result, diagnosis: str) -> str:
    """Return the page; ``diagnosis`` is the diagnosis in plain sentences."""
    from plotly.offline import get_plotlyjs

    charts = [_errors(result), _flexibilities(result)]
    return "\n".join([
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><title>Gapbridge demo</title>',
        f"<style>{STYLE}</style>",
        f"<script>{get_plotlyjs()}</script></head><body>",
        f"<h1>The whole job on a simulated {escape(result.model.arm.name)}</h1>",
        _lead(result),
        picture(result),
        _truth(result),
        "<h2>Every visit</h2>", charts[0],
        "<h2>What was found of the arm</h2>", charts[1], _flexibility_table(result),
        "<h2>What the diagnosis says of what the fit leaves</h2>",
        f"<pre>{escape(diagnosis)}</pre>",
        '<p>In pictures: <a href="diagnosis/report.html">the diagnosis</a>.</p>',
        "<h2>How it was done</h2>", _figures(result),
        "</body></html>",
    ]) + "\n"  # fmt: skip


def _lead(result: Result) -> str:
    errors = result.summary()["tcp_error_mm"]
    ratio = errors["without"]["rms"] / errors["with"]["rms"]
    return (
        f"<p>Without compensation the tool misses its place by {errors['without']['rms']:.3f} mm "
        f"rms (at most {errors['without']['max']:.3f}); with it, by {errors['with']['rms']:.3f} mm "
        f"({errors['with']['max']:.3f}): {ratio:.0f} times less. The arm comes back to a place "
        f"within {result.repeatability * 1e3:.3f} mm. The arm's flexibilities are drawn from seed "
        f"{result.seed}; nothing that corrects the arm knows them.</p>"
    )


def _truth(result: Result) -> str:
    """Return what was hidden beside what was found."""
    lines = truth_lines(result)
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line.strip())}</li>" for line in lines[1:])
    return (
        f"<h2>The hidden truth, and what was found</h2><p>{escape(lines[0])}.</p><ul>{items}</ul>"
    )


def _chart(traces: list[Any], title_y: str, title_x: str, **layout: Any) -> str:
    import plotly.graph_objects as go

    figure = go.Figure(traces)
    figure.update_layout(
        template="plotly_white", height=380, margin={"l": 60, "r": 20, "t": 30, "b": 50},
        xaxis_title=title_x, yaxis_title=title_y, **layout,
    )  # fmt: skip
    text: str = figure.to_html(full_html=False, include_plotlyjs=False)
    return text


def _errors(result: Result) -> str:
    import plotly.graph_objects as go

    visit = np.arange(1, len(result.loads) + 1)
    told = [
        f"{load}<br>q = {np.round(q, 3).tolist()}"
        for load, q in zip(result.loads, result.without.nominal_q, strict=True)
    ]
    traces: list[Any] = [
        go.Scatter(x=visit, y=error * 1e3, mode="markers", name=name, text=told,
                   marker={"color": colour, "size": 10})
        for (name, error), colour in zip(
            result.series, (RED, AMBER, GREEN) if len(result.series) == 3 else (RED, GREEN),
            strict=True,
        )
    ]  # fmt: skip
    traces.append(
        go.Scatter(x=visit[[0, -1]], y=[result.repeatability * 1e3] * 2, mode="lines",
                   name="repeatability", line={"color": "#9aa5b1", "dash": "dash"})
    )  # fmt: skip
    return _chart(traces, "distance from the wanted place, mm", "visit", yaxis_type="log")


def _flexibilities(result: Result) -> str:
    import plotly.graph_objects as go

    found = result.identification
    joints = [f"joint {i + 1}" for i in range(len(found.axial))]
    traces = [
        go.Bar(
            x=joints,
            y=np.where(shown, value * 1e6, 0),
            name=name,
            error_y={"array": 2e6 * np.where(shown, std, 0)},
        )
        for name, value, std, shown in (
            ("axial", found.axial, found.std_axial, found.identifiable[: len(joints)]),
            ("radial", found.radial, found.std_radial, found.identifiable[len(joints) :]),
        )
    ]
    return _chart(traces, "flexibility, 1e-6 rad/Nm (bars: 2 sigma)", "", barmode="group")


def _flexibility_table(result: Result) -> str:
    found = result.identification
    n = len(found.axial)

    def cell(value: float, std: float, shown: bool) -> str:
        told = f"{value * 1e6:.3f} ± {std * 1e6:.3f}" if shown else "not identifiable"
        return f"<td>{told}</td>"

    rows = "".join(
        f"<tr><td>{i + 1}</td>"
        + cell(found.axial[i], found.std_axial[i], bool(found.identifiable[i]))
        + cell(found.radial[i], found.std_radial[i], bool(found.identifiable[n + i]))
        + "</tr>"
        for i in range(n)
    )
    notes = "".join(f"<li>{escape(n)}</li>" for n in (*found.notes, *found.combinations))
    return (
        "<table><tr><th>joint</th><th>axial, 1e-6 rad/Nm</th><th>radial, 1e-6 rad/Nm</th></tr>"
        f"{rows}</table><ul>{notes}</ul>"
    )


def _count(length: float) -> str:
    return f"{length * 1e3:.3g} mm" if length else "64-bit floats"


def _figures(result: Result) -> str:
    figures, loop = result.summary(), result.loop
    lines = (
        ("link", result.link),
        ("measured poses in the fit", f"{figures['samples']}"),
        ("setpoints written", f"{figures['setpoints_written']}"),
        ("rate of the loop", f"{loop.rate:.1f} Hz"),
        ("cycles missed", f"{loop.missed} of {loop.cycles}"),
        ("age of the state behind a setpoint, p99", f"{loop.p99:.0f} us"),
        ("one count of what is written, at the TCP", _count(result.resolution.written)),
        ("one count of the joints as read, at the TCP", _count(result.resolution.read)),
        ("what that means", result.resolution.note or "nothing is lost on the wire"),
        ("whole demo", f"{result.duration:.0f} s"),
    )
    rows = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in lines)
    return f'<table class="figures">{rows}</table>'
