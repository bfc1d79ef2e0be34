"""Generate docs/catalogue.md from the docstrings of the effects.

Example: python -m benchmarks.evidence.catalogue_page docs/catalogue.md
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

from gapbridge.bridge.cli.cell.explain import ARM, parameter_texts
from gapbridge.bridge.report.labels import CHANNELS as CHANNEL_TITLES
from gapbridge.bridge.report.labels import effect_title
from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import CATALOGUE, CHANNELS, Effect, ties_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "catalogue.md"
HEAD = """\
# The catalogue of effects

Generated from the effects' docstrings by `python -m benchmarks.evidence.catalogue_page`;
do not edit.
`gapbridge explain EFFECT` prints the same text. Parameters are what the real arm has more than the
model, in SI units.
"""


def catalogue_page() -> str:
    """Return the page as Markdown: a table of effects per channel, then a section per effect."""
    parts = [HEAD]
    for channel, unit in CHANNELS.items():
        parts += [f"## {CHANNEL_TITLES[channel]} (`{channel}`, {unit})", "", _table(channel), ""]
    parts += ["## Effect by effect", ""]
    parts += [_effect(effect) for effect in CATALOGUE.values()]
    return "\n".join(parts).rstrip() + "\n"


def _table(channel: str) -> str:
    rows = ["| effect | in plain words | where |", "| --- | --- | --- |"]
    for name, effect in CATALOGUE.items():
        if channel in effect.channels:
            rows.append(f"| [`{name}`](#{name}) | {effect_title(name)} | {_place(effect)} |")
    return "\n".join(rows)


def _place(effect: Effect) -> str:
    return "one joint each" if effect.sites(builtin_arm(ARM))[0].joint else "the whole arm"


def _effect(effect: Effect) -> str:
    lines = [f"### {effect.identifier}", "", inspect.getdoc(effect) or "", ""]
    lines.append(f"- shows in: {', '.join(effect.channels)}; acts at: {_place(effect)}")
    if effect.motion:
        lines.append(f"- the log must hold: {effect.motion}")
    for other, data in ties_of(effect.identifier).items():
        lines.append(f"- looks the same as `{other}` on: {data}")
    if effect.needs:
        lines.append(f"- columns beyond the channel's own: {', '.join(effect.needs)}")
    names = [f"`{name}` ({unit})" for name, unit in parameter_texts(effect)]
    return "\n".join([*lines, f"- parameters: {', '.join(names)}", ""])


def main(arguments: list[str]) -> int:
    """Write the page to the file in ``arguments``, by default docs/catalogue.md."""
    path = Path(arguments[0]) if arguments else PAGE
    path.write_text(catalogue_page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
