"""The session: who measured what, where, when and with what."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.figures import load_title, mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import plain
from gapbridge.bridge.document.blocks import Block, Bullets, Columns, Heading, Pairs
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.report.labels import parameter_title, sentence

KINDS = {
    "position": "position of a target on the tool, three coordinates",
    "pose": "position and orientation of a target on the tool",
    "distance": "distance from a fixed point to a target on the tool",
    "sphere": "the tool brought onto a fixed sphere, joint angles alone",
    "relative": "one target on the tool against another",
    "point": "the tool's tip brought onto one fixed point, joint angles alone",
    "touch": "the tool's tip brought onto one fixed place, joint angles alone",
    "wrench": "forces and torques at the flange",
}


def session_and_instrument(material: Material) -> list[Block]:
    """Return the facts as on the front of a certificate."""
    c, facts = material.calibration, material.session
    counts = [
        ("poses", _poses_text(material)),
        ("readings", _readings_text(material)),
        ("loads", _loads_text(material)),
    ]
    notes = note_texts((*c.notes, *(material.plan.notes if material.plan else ())), parameter_title)
    return facts_blocks(facts, counts, len(c.stations), notes)


def facts_blocks(
    facts: SessionFacts, counts: list[tuple[str, str]], places: int = 1, notes: Sequence[str] = ()
) -> list[Block]:
    """Return a session's facts beside its instrument's, and all remarks."""
    blocks: list[Block] = [
        Columns((
            Pairs(tuple(_front(facts) + counts), "Session"),
            Pairs(tuple(_instrument(facts, places)), "Instrument"),
        ))
    ]  # fmt: skip
    remarks = tuple(sentence(text) for text in (*facts.remarks, *notes))
    return [*blocks, Heading("Remarks"), Bullets(remarks)] if remarks else blocks


def _front(facts: SessionFacts) -> list[tuple[str, str]]:
    start, end = facts.started, facts.ended
    minutes = round((end - start).total_seconds() / 60)
    last = f"{end:%H:%M}" if end.date() == start.date() else f"{end:%Y-%m-%d %H:%M}"
    given = [
        ("report", facts.number), ("software", facts.version and f"Gapbridge {facts.version}"),
        ("customer", facts.customer), ("cell", facts.cell),
        ("SHA-256 of the cell file", _grouped(facts.cell_sha256)), ("arm", facts.arm),
        ("serial number", facts.serial),
        ("measured", f"{start:%Y-%m-%d %H:%M} to {last} ({minutes} min)"),
        ("by", facts.operator), ("surroundings", facts.environment),
        ("data", str(facts.folder)),
    ]  # fmt: skip
    return [(name, text) for name, text in given if text]


def _grouped(digest: str) -> str:
    """Return a digest in groups, so that it can be read aloud and breaks over lines."""
    return " ".join(digest[i : i + 8] for i in range(0, len(digest), 8))


def _instrument(facts: SessionFacts, stations: int) -> list[tuple[str, str]]:
    tool = facts.instrument
    noise = ""
    far = tool.distance > 0 and tool.kind in ("position", "pose", "distance")
    if tool.kind not in ("wrench", "touch"):
        noise = f"{mm(tool.sigma)} (1 sigma of one coordinate)"
    given = [
        ("instrument", tool.name), ("serial number", tool.serial),
        ("its own calibration", tool.certificate),
        ("measures", KINDS.get(tool.kind, tool.kind)),
        ("noise, declared", noise),
        ("distance", f"{plain(tool.distance)} m" if far else ""),
        ("places", f"{stations}" if stations > 1 else ""),
    ]  # fmt: skip
    return [(name, text) for name, text in given if text]


def _poses_text(material: Material) -> str:
    readings = material.calibration.readings
    held = len(set(readings.pose[readings.held_out].tolist()))
    fitted = len(set(readings.pose[~readings.held_out].tolist()))
    return f"{fitted} to fit, {held} kept out of the fit to check it"


def _readings_text(material: Material) -> str:
    facts, outliers = material.session, len(material.calibration.outliers)
    text = f"{facts.readings}"
    if facts.undone:
        text += f"; {facts.undone} were taken back"
    if outliers:
        text += f"; {outliers} {'was' if outliers == 1 else 'were'} outlying and down-weighted"
    return text


def _loads_text(material: Material) -> str:
    plan = material.plan
    if plan is None:
        return str(len(set(material.calibration.readings.load.tolist())))
    return "; ".join(load_title(p.mass, p.name) for p in plan.loads)
