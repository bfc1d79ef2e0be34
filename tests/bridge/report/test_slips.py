"""Slips in the report: in the answer, marked in the plots, with the gap before and after."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from html import unescape
from itertools import pairwise

import numpy as np
import pytest

from gapbridge.bridge.cli.log.diagnosis_text import diagnosis_text
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.diagnosis_json import document as diagnosis_json
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.numbers import with_unit
from gapbridge.bridge.document.pdf import pdf
from gapbridge.bridge.report.answer import answer, next_steps
from gapbridge.bridge.report.gap_location import gap_location
from gapbridge.bridge.report.gap_reduction import gap_reduction
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.page import document
from gapbridge.bridge.report.slips import sample_sizes, slip_section, slips_of, stretches
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.sessions import join_sessions

MODEL = Model(builtin_arm("ur5e"), payload_mass=2.0, payload_cog=np.array([0.0, 0.0, 0.06]))
START, EVERY = 1796000000.0, 110.0  # s: 2026-11-30 00:53:20 UTC, between rows
SIGMA = 2e-5  # m
JOINT_2, JOINT_5 = (
    Term("joint_slip", Site(2), (4e-3, 30.5)),
    Term("joint_slip", Site(5), (2e-2, 50.5)),
)
TARGET = Term("target_slip", Site(), (1e-3, -5e-4, 2e-3, 30.5))
CASES: dict[str, tuple[Term, ...]] = {
    "joint": (JOINT_2,), "target": (TARGET,), "two": (JOINT_2, JOINT_5), "untimed": (JOINT_2,),
    "uptime": (TARGET,), "together": (JOINT_2, Term("joint_slip", Site(5), (2e-2, 30.5))),
}  # fmt: skip
"""Slips, whose times are rows: the first has 30 rows before it."""


@dataclass(frozen=True)
class Case:
    material: Material
    gap: np.ndarray  # (N, 3) m, measured minus predicted without slips


def logged(terms: tuple[Term, ...], start: float | None, count: int = 70, seed: int = 3) -> Log:
    """Return poses of an arm with slips at rows; without ``start`` the log has no clock."""
    rng = np.random.default_rng(seed)
    q = np.array([0.2, -1.2, 1.4, -1.0, -1.4, 0.3]) + rng.uniform(-0.8, 0.8, (count, 6))
    rows = Loads(time=np.arange(1.0, count + 1.0))
    measured = MODEL.with_terms(list(terms)).predict(q, rows).position
    columns = {"actual_q": q, "measured_position": measured + rng.normal(0, SIGMA, (count, 3))}
    if start is not None:
        columns["timestamp"] = start + EVERY * np.arange(count)
    return Log("slip.csv", columns, 6)


@cache
def reported(name: str) -> Case:
    """Return the input of the report of one of CASES, measured in the base frame."""
    log = logged(CASES[name], {"untimed": None, "uptime": 5321.0}.get(name, START))
    diagnosis = diagnose(MODEL, log, Metrology(registered=True, sigma=SIGMA))
    gap = log.columns["measured_position"] - MODEL.predict(log.columns["actual_q"]).position
    return Case(Material(diagnosis, "cell", log, MODEL), gap)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def answer_of(case: Case) -> list[str]:
    """Return what the answer says about the slips."""
    shown = answer(case.material)
    heading = shown.index(blocks.Heading("What slipped, and when"))
    items = shown[heading + 1]
    assert isinstance(items, blocks.Bullets)
    return [*items.items]


@pytest.mark.parametrize(("name", "sentences"), [
    ("joint", [r"The zero of joint 2 moved by (4|4\.0\d|3\.9\d) mrad \(0\.2[23]\d? deg\) between "
               r"01:46:30 and 01:48:20; before and after it nothing else changed\."]),
    ("target", [r"The target on the tool moved by 2\.(2[89]|3) mm between 01:46:30 and 01:48:20; "
                r"before and after it nothing else changed\."]),
    ("untimed", [r"The zero of joint 2 moved by \S+ mrad \(\S+ deg\) between rows 30 and 31 of the "
                 r"log, counted without its header; before and after it nothing else changed\."]),
    ("uptime", [r"The target on the tool moved by \S+ mm between 3190 s and 3300 s from the start; "
                r"before and after it nothing else changed\."]),
    ("two", [r"The zero of joint 2 moved by \S+ mrad \(\S+ deg\) between 01:46:30 and 01:48:20; "
             r"besides the slips nothing else changed\.",
             r"The zero of joint 5 moved by \S+ mrad \(1\.1\d deg\) between 02:23:10 and 02:25:00; "
             r"besides the slips nothing else changed\."]),
    ("together", [r"The zero of joint 2 moved by .* between 01:46:30 and 01:48:20; besides .*",
                  r"The zero of joint 5 moved by .* between 01:46:30 and 01:48:20; besides .*"]),
])  # fmt: skip
def test_the_answer_tells_what_slipped_how_far_and_when(name: str, sentences: list[str]) -> None:
    case = reported(name)
    texts = answer_of(case)
    assert len(texts) == len(sentences)
    for text, sentence in zip(texts, sentences, strict=True):
        assert re.match(sentence, text), text
    terminal = diagnosis_text(case.material.diagnosis)
    for text in texts:
        first, second = text.removesuffix(".").split(". Gap")
        assert f"slip: {first[0].lower()}{first[1:]}\n    gap{second}" in terminal
    assert terminal.count("moved by") == len(sentences)
    named = name not in ("untimed", "uptime")
    assert (blocks.Paragraph("Times of day are local (UTC).", "note") in answer(case.material)) is (
        named
    )


@pytest.mark.parametrize("name", list(CASES))
def test_the_gap_before_and_after_is_that_of_the_rows_before_and_after(name: str) -> None:
    """Recomputed from the model: without causes, and with the terms of the diagnosis in it."""
    case = reported(name)
    (channel,) = case.material.diagnosis.channels
    log = case.material.log
    edges = [0, 30, *([50] if name == "two" else []), 70]
    with_causes = (
        log.columns["measured_position"]
        - case.material.diagnosis.model.predict(
            log.columns["actual_q"], Loads(time=log.times())
        ).position
    )
    parts = stretches(channel, slips_of(case.material.diagnosis, channel))
    assert [part.samples for part in parts] == [b - a for a, b in pairwise(edges)]
    for part, (begin, end) in zip(parts, pairwise(edges), strict=True):
        assert part.without == pytest.approx(rms(case.gap[begin:end]), rel=1e-6)
        assert part.with_causes == pytest.approx(rms(with_causes[begin:end]), rel=0.1)
    assert parts[0].without < 1.3 * SIGMA  # nothing has slipped yet
    assert parts[1].without > 10 * SIGMA
    weights = [part.samples / channel.samples for part in parts]
    total = sum(w * part.with_causes**2 for w, part in zip(weights, parts, strict=True))
    assert np.sqrt(total) == pytest.approx(channel.remaining_rms_held_out, rel=1e-6)
    (table, _) = slip_section(case.material)
    assert isinstance(table, blocks.Table)
    assert [list(row[1:]) for row in table.rows] == [
        [str(p.samples), with_unit(p.without, "m"), with_unit(p.with_causes, "m")] for p in parts
    ]
    assert with_unit(parts[0].without, "m") in answer_of(case)[0]
    assert with_unit(parts[1].without, "m") in answer_of(case)[0]


def test_without_a_fitted_frame_the_sizes_are_those_of_the_channel() -> None:
    (channel,) = reported("two").material.diagnosis.channels
    without, with_causes = sample_sizes(channel)
    assert rms(without) == pytest.approx(channel.gap_rms)
    assert rms(with_causes) == pytest.approx(channel.remaining_rms_held_out)


DASHED = re.compile(r'<polyline points="([\d.]+),[\d.]+ ([\d.]+),[\d.]+" fill="none" '
                    r'stroke="var\(--violet\)"[^>]*stroke-dasharray')  # fmt: skip
DOTS = re.compile(r'<path class="dots" d="([^"]+)" fill="none" stroke="var\(--before\)"')


def pictures(drawn: list[blocks.Block]) -> list[str]:
    """Return the SVG of each drawing with a slip in it."""
    part = blocks.Part("a", "a", "", drawn)
    page = html(blocks.Document("a", "a", (part,)))
    return [svg for svg in re.findall(r"<svg.*?</svg>", unescape(page)) if "slip: " in svg]


@pytest.mark.parametrize("name", list(CASES))
@pytest.mark.parametrize("section", [slip_section, gap_location, gap_reduction])
def test_plots_over_time_have_a_mark_between_the_rows_of_each_slip(name: str, section) -> None:
    case = reported(name)
    found = pictures(section(case.material))
    if section is gap_location and name == "untimed":
        assert not found  # nothing is plotted over the rows there
        return
    assert found
    labels = {"joint": ["joint 2"], "untimed": ["joint 2"], "two": ["joint 2", "joint 5"],
              "together": ["joints 2 and 5"]}.get(name, ["target"])  # fmt: skip
    for svg in found:
        marks = [float(a) for a, b in DASHED.findall(svg) if a == b]
        assert re.findall(r"slip: ([^<]+)<", svg) == labels
        (dots,) = DOTS.findall(svg)
        across = np.array([float(x) for x in re.findall(r"M([\d.]+) ", dots)])
        assert [int((across < mark).sum()) for mark in marks] == [30, 50][: len(labels)]
        assert len(across) == 70


def test_the_axis_of_a_log_with_dates_has_times_of_day() -> None:
    (_, shown) = slip_section(reported("joint").material)
    assert isinstance(shown, blocks.Pictures)
    texts = [shape.text for shape in shown.drawings[0].shapes if hasattr(shape, "text")]
    times = [text for text in texts if re.fullmatch(r"\d\d:\d\d:00", text)]
    assert len(times) == len({*times}) >= 4
    assert "time of day, 2026-11-30 (UTC)" in texts


def test_what_to_do_names_what_slipped_and_nothing_to_correct_in_the_log() -> None:
    steps = " ".join(next_steps(reported("together").material.diagnosis))
    assert "why it slipped (joints 2 and 5): a collision, a belt, a coupling or an encoder" in steps
    assert "Data quality" not in steps
    assert "a target that was knocked" in " ".join(
        next_steps(reported("target").material.diagnosis)
    )


def test_a_row_is_no_number_of_seconds() -> None:
    material = reported("untimed").material
    assert "joint_slip_2_time = after row 30\n" in diagnosis_text(material.diagnosis)
    page = html(document(material))
    assert "after row 30" in page
    assert "30.5 s" not in page
    (cause,) = diagnosis_json(material.diagnosis)["channels"][0]["causes"]
    assert [(p["name"], p["unit"]) for p in cause["parameters"]] == [
        ("joint_slip_2", "rad"), ("joint_slip_2_time", ""),
    ]  # fmt: skip


def test_the_report_with_slips_can_be_printed() -> None:
    assert pdf(document(reported("two").material)).startswith(b"%PDF")


@pytest.mark.parametrize("one_clock", [True, False])
def test_a_slip_between_two_sessions(one_clock: bool) -> None:
    logs = []
    for k, name in enumerate(("monday", "tuesday", "friday")):
        terms = (Term("joint_slip", Site(2), (4e-3, 0.0)),) if k else ()
        part = logged(terms, START + 86400.0 * k * one_clock, count=36, seed=k)
        logs.append(Log(f"{name}.csv", part.columns, 6))
    log = join_sessions(logs, MODEL)
    diagnosis = diagnose(MODEL, log, Metrology(registered=False, sigma=SIGMA))
    case = Case(Material(diagnosis, "cell", log, MODEL), np.zeros(0))
    (text,) = answer_of(case)
    (table, shown) = slip_section(case.material)
    assert isinstance(table, blocks.Table)
    assert isinstance(shown, blocks.Pictures)
    titles, samples = zip(*(row[:2] for row in table.rows), strict=True)
    assert samples == ("36", "72")
    texts = " ".join(s.text for s in shown.drawings[0].shapes if hasattr(s, "text"))
    if one_clock:
        assert "between 2026-11-30 01:57:30 and 2026-12-01 00:53:20" in text
        assert titles == ("until 2026-11-30 01:57:30", "from 2026-12-01 00:53:20 on")
        assert "date and time (UTC)" in texts
    else:
        assert "tuesday.csv is the first session that has it" in text
        assert titles == ("before tuesday.csv", "from tuesday.csv on")
        assert "s from the first row" in texts
