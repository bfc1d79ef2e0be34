"""The session and its instrument: who measured what, where, when and with what."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.calibration.report.data import CalibrationData, SessionFacts
from gapbridge.bridge.document.blocks import Block, Bullets, Columns, Heading, Pairs
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.numbers import load_title, mm, plain
from gapbridge.bridge.report.labels import parameter_title, sentence

KINDS = {
    "position": "position of a target on the tool, three coordinates",
    "pose": "position and orientation of a target on the tool",
    "distance": "distance from a fixed point to a target on the tool",
    "sphere": "contact of the tool with a fixed sphere, joint angles alone",
    "relative": "vector from one target on the tool to another",
    "point": "contact of the tool's tip with one fixed point, joint angles alone",
    "touch": "contact of the tool's tip with one fixed point, joint angles alone",
    "wrench": "forces and torques at the flange",
}


def session_and_instrument(data: CalibrationData) -> list[Block]:
    """Return the facts of a calibration session."""
    c, facts = data.calibration, data.session
    counts = [
        ("poses", _poses_text(data)),
        ("readings", _readings_text(data)),
        ("loads", _loads_text(data)),
    ]
    notes = note_texts((*c.notes, *(data.plan.notes if data.plan else ())), parameter_title)
    return facts_blocks(facts, counts, len(c.stations), notes)


def facts_blocks(
    facts: SessionFacts, counts: list[tuple[str, str]], places: int = 1, notes: Sequence[str] = ()
) -> list[Block]:
    """Return the facts of session and instrument, and all remarks."""
    blocks: list[Block] = [
        Columns((
            Pairs(tuple(_session_pairs(facts) + counts), "Session"),
            Pairs(tuple(_instrument_pairs(facts, places)), "Instrument"),
        ))
    ]  # fmt: skip
    remarks = tuple(sentence(text) for text in (*facts.remarks, *notes))
    return [*blocks, Heading("Remarks"), Bullets(remarks)] if remarks else blocks


def _session_pairs(facts: SessionFacts) -> list[tuple[str, str]]:
    start, end = facts.started, facts.ended
    minutes = round((end - start).total_seconds() / 60)
    last = f"{end:%H:%M}" if end.date() == start.date() else f"{end:%Y-%m-%d %H:%M}"
    pairs = [
        ("report", facts.number), ("software", facts.version and f"Gapbridge {facts.version}"),
        ("customer", facts.customer), ("cell", facts.cell),
        ("SHA-256 of the cell file", _grouped(facts.cell_sha256)), ("arm", facts.arm),
        ("serial number", facts.serial),
        ("measured", f"{start:%Y-%m-%d %H:%M} to {last} ({minutes} min)"),
        ("by", facts.operator), ("surroundings", facts.environment),
        ("data", str(facts.folder)),
    ]  # fmt: skip
    return [(name, text) for name, text in pairs if text]


def _grouped(digest: str) -> str:
    """Return a digest in groups of eight, so that it can wrap."""
    return " ".join(digest[i : i + 8] for i in range(0, len(digest), 8))


def _instrument_pairs(facts: SessionFacts, stations: int) -> list[tuple[str, str]]:
    tool = facts.instrument
    noise = ""
    far = tool.distance > 0 and tool.kind in ("position", "pose", "distance")
    if tool.kind not in ("wrench", "touch"):
        noise = f"{mm(tool.sigma)} (1 sigma of one coordinate)"
    pairs = [
        ("instrument", tool.name), ("serial number", tool.serial),
        ("its own calibration", tool.certificate),
        ("measures", KINDS.get(tool.kind, tool.kind)),
        ("noise, declared", noise),
        ("distance", f"{plain(tool.distance)} m" if far else ""),
        ("places", f"{stations}" if stations > 1 else ""),
    ]  # fmt: skip
    return [(name, text) for name, text in pairs if text]


def _poses_text(data: CalibrationData) -> str:
    readings = data.calibration.readings
    held = len(set(readings.pose[readings.held_out].tolist()))
    fitted = len(set(readings.pose[~readings.held_out].tolist()))
    return f"{fitted} to fit, {held} held out to verify"


def _readings_text(data: CalibrationData) -> str:
    facts, outliers = data.session, len(data.calibration.outliers)
    text = f"{facts.readings}"
    if facts.undone:
        text += f"; {facts.undone} were discarded"
    if outliers:
        text += f"; {outliers} outlier{'s'[: outliers > 1]} down-weighted"
    return text


def _loads_text(data: CalibrationData) -> str:
    plan = data.plan
    if plan is None:
        return str(len(set(data.calibration.readings.load.tolist())))
    return "; ".join(load_title(p.mass, p.name) for p in plan.loads)
