"""One call of `gapbridge calibrate`: start or resume a session, measure, evaluate."""

from __future__ import annotations

import shlex
import signal
from contextlib import ExitStack
from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.calibration.format import load_text
from gapbridge.bridge.calibration.instruments.instrument import (
    AnyInstrument,
    Ask,
    InstrumentContext,
    ReadingError,
)
from gapbridge.bridge.calibration.jobs.calibrate import CalibrationJob
from gapbridge.bridge.calibration.jobs.job import Job
from gapbridge.bridge.calibration.jobs.short import PayloadJob, ToolJob
from gapbridge.bridge.calibration.jobs.verify import VerifyJob
from gapbridge.bridge.calibration.joints.joint_source import JointSource, PlannedJoints, TypedJoints
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import (
    CONTACT_KINDS,
    metrology_of,
    with_loads,
    workspace_of,
)
from gapbridge.bridge.calibration.session.folders import check_start, session_folder, start_entry
from gapbridge.bridge.calibration.session.journal import Journal
from gapbridge.bridge.calibration.session.measuring import Measuring
from gapbridge.bridge.calibration.session.positioning import CollisionCheck, Positioning
from gapbridge.bridge.calibration.session.prompt import InputEnded, Prompt, SessionCommand
from gapbridge.bridge.calibration.session.session import Session, write_poses
from gapbridge.bridge.cell import Cell
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.clock import SYSTEM

JOBS: dict[str, tuple[str, type[Job]]] = {
    "whole": ("Calibration of", CalibrationJob),
    "verify": ("Verification of", VerifyJob),
    "payload": ("Load and force sensor of", PayloadJob),
    "tool": ("Tool of", ToolJob),
}
"""SessionOptions.kind -> title and job."""


def run_session(cell: Cell, options: SessionOptions) -> None:
    """Start or resume a session. Raises InputError, RunError; click's Exit after Ctrl-C."""
    folder = session_folder(cell, options)
    journal = Journal(folder)
    with journal:
        session = Session.of(journal)
        prompt = Prompt(lambda text: session.add("note", text=text))
        try:
            _run(cell, options, prompt, session)
        except SessionCommand as command:
            if command.name == "undo":  # at the last question
                prompt.say(session.undo())
            prompt.say(_how_to_resume(cell, options, session))
        except InputEnded:
            prompt.say()
            prompt.say(f"the input ended; {_how_to_resume(cell, options, session)}")
        except KeyboardInterrupt:
            prompt.say()
            prompt.say(f"interrupted; {_how_to_resume(cell, options, session)}")
            raise click.exceptions.Exit(128 + signal.SIGINT) from None
        except InputError:
            if not session.has_begun:
                journal.discard()  # nothing to resume
            elif session.next_stop is None:
                prompt.say(
                    f"the readings in {folder} are kept; to measure anew give another --session"
                )
            raise
        except LinkError:
            prompt.say(_how_to_resume(cell, options, session))
            raise


def _run(cell: Cell, options: SessionOptions, prompt: Prompt, session: Session) -> None:
    folder = session.journal.path.parent
    title, kind = JOBS[options.kind]
    prompt.say(f"{title} {cell.path}: {cell.arm.name}", "bold")
    job = kind(cell, options, prompt, session)
    if session.start_entry and session.has_begun:
        check_start(session.start_entry, cell, options, folder)
        _report_resumed(prompt, session, folder)
    else:
        session.add("begun", **start_entry(cell, options))
        prompt.say(f"new session in {folder}")
    context = InstrumentContext(
        ask=lambda question: prompt.ask(f"  {question}"),
        link_host=str(getattr(cell.link, "host", "") or ""),
        since=float(session.start_entry["time"]),
    )
    with ExitStack() as stack:
        joints = make_joint_source(cell, options, context.ask, folder)
        instrument = None
        if not options.plan_only and (session.plan is None or session.next_stop is not None):
            instrument = job.instrument(context)  # before planning: reports what is missing
            with prompt.waiting("reaching the instrument"):
                stack.enter_context(instrument)
        if job.starts_at_current_pose and (session.plan is None or session.next_stop is not None):
            _open(prompt, stack, joints)
        if session.plan is None:
            _make_plan(job, joints)
        else:
            _report_existing_plan(job)
        if options.plan_only:
            prompt.say(f"joints of every stop: {folder / 'poses.csv'}")
            prompt.say(f"to measure: {_command(cell, options, session)}")
            return
        if session.next_stop is not None:
            assert instrument is not None
            if not job.starts_at_current_pose:
                _open(prompt, stack, joints)
            _measure(job, joints, instrument)
    job.require_same_cell()
    job.finish()


def _open(prompt: Prompt, stack: ExitStack, joints: JointSource) -> None:
    with prompt.waiting("reaching the arm"):
        stack.enter_context(joints)


def _start_joints(job: Job, joints: JointSource) -> Array:
    """Return the present joint angles (n,), rad, from which the plan starts."""
    n = job.cell.arm.n
    current = joints.current_q()
    while current is None:
        try:
            q = joints.sample_at_rest(PlannedPose(0, np.full(n, np.nan), 0, np.zeros(n))).q
        except ReadingError as error:
            job.prompt.warn(str(error))
            continue
        if np.isfinite(q).all():
            current = q
        else:
            job.prompt.warn(
                "found nothing, expected where the arm stands now: the plan starts there"
            )
    return current


def _make_plan(job: Job, joints: JointSource) -> None:
    prompt, session = job.prompt, job.session
    begin = _start_joints(job, joints) if job.starts_at_current_pose else None
    with prompt.waiting("planning") as emit:
        plan = job.plan(begin, lambda text, share: emit(f"planning: {text} ({share:.0%})"))
    session.add_plan(plan)
    write_poses(plan, job.folder / "poses.csv")
    job.report_plan(plan)


def _report_existing_plan(job: Job) -> None:
    """Print the plan of an earlier call with --plan-only; warn of options that it ignores."""
    options, seed = job.options, job.session.start_entry.get("seed")
    for option, ignored in (
        ("--poses", options.poses is not None), ("--seed", options.seed not in (0, seed)),
    ):  # fmt: skip
        if ignored:
            job.prompt.warn(f"this session already has a plan: {option} has no effect")
    if job.options.plan_only and job.session.plan is not None:
        job.report_plan(job.session.plan)
    _warn_of_obstacles(job)


def _warn_of_obstacles(job: Job) -> None:
    """Warn of stops that the cell's obstacles and limits, changed since the plan, do not allow."""
    stops = [] if job.starts_at_current_pose else job.session.open_stops
    if stops:
        is_free = _collision_check(job)(np.array([job.session.stops[i].q for i in stops]))
        hit = [str(i + 1) for i, free in zip(stops, is_free, strict=True) if not free]
        if hit:
            job.prompt.warn(
                f"planned before the cell's floor, boxes or joint range were changed, and not free "
                f"of them now: stops {', '.join(hit)}; `skip` them, or begin another --session"
            )


def _report_resumed(prompt: Prompt, session: Session, folder: Path) -> None:
    count = len(session.stops)
    done = count - session.remaining
    prompt.say(f"resuming the session in {folder}: {done} of {count} stops are measured")
    if session.journal.torn:
        prompt.say("  the last line of its journal was incomplete and is ignored")
    if session.accepted:
        prompt.say(f"  the last reading kept: stop {session.accepted[-1].stop + 1}")
        if session.next_stop is not None:
            prompt.say("  if the instrument was moved since, type `moved`; `back` finds out")
    if session.mounted is not None and session.plan is not None and session.next_stop is not None:
        prompt.say(f"  on the flange: {load_text(session.plan.loads[session.mounted])}")


def _measure(job: Job, joints: JointSource, instrument: AnyInstrument) -> None:
    prompt, settings, options = job.prompt, job.cell.calibration, job.options
    if instrument.contact and options.move:
        raise job.cell.error(
            ("calibration", "instrument", "kind"),
            f"found {options.instrument.kind!r} with --move, expected another: the tool is brought "
            "onto something by hand",
        )
    if instrument.contact and isinstance(joints, PlannedJoints):
        raise job.cell.error(
            ("calibration", "joints"),
            f"found 'planned' with an instrument of kind {options.instrument.kind!r}, expected "
            "'link' or 'typed': the joints are the reading",
        )
    prompt.say(f"instrument: {instrument.name}; joints: {_joints_text(joints, options)}")
    prompt.say("at every question: Enter continues, `undo`, `back`, `skip`, `quit`, `?`")
    earlier = () if job.session.used_sources else instrument.earlier(joints.detects_rest)
    if earlier:  # a plan of the same seed has the same stops: they would fit the arm of that time
        job.session.add("rejected", sources=earlier, reasons=["of before the session"])
        prompt.warn(f"readings from before this session are not used: {len(earlier)}")
    positioning = Positioning(
        prompt, job.session, joints, instrument, _collision_check(job), settings
    )
    sigma = metrology_of(job.cell, options.instrument).sigma
    Measuring(
        prompt, job.session, positioning, instrument, job.reading_check(), sigma, settings.samples
    ).run()


def _collision_check(job: Job) -> CollisionCheck:
    assert job.session.plan is not None
    workspace = with_loads(workspace_of(job.cell, "position", 0.0), job.session.plan.loads)
    return lambda q: np.asarray(workspace.clear(q), dtype=float)


def _joints_text(joints: JointSource, options: SessionOptions) -> str:
    if joints.detects_rest:
        return "from the controller" + (", which Gapbridge drives" if options.move else "")
    return "as planned" if isinstance(joints, PlannedJoints) else "typed in degrees"


def _how_to_resume(cell: Cell, options: SessionOptions, session: Session) -> str:
    done = len(session.stops) - session.remaining
    kept = f"{done} of {len(session.stops)} stops are measured and kept; " if session.stops else ""
    return f"{kept}to resume: {_command(cell, options, session)}"


def _command(cell: Cell, options: SessionOptions, session: Session) -> str:
    folder = session.journal.path.parent
    parts = ["gapbridge", "calibrate", str(cell.path), "--session", str(folder)]
    flags = {"verify": "--verify", "payload": "--payload-only", "tool": "--tool-only"}
    parts += [flags[options.kind]] if options.kind in flags else []
    parts += ["--move"] if options.move else []
    parts += ["--apply", str(options.new_cell)] if options.new_cell else []
    return shlex.join(parts)


def make_joint_source(cell: Cell, options: SessionOptions, ask: Ask, folder: Path) -> JointSource:
    """Return the source of joint angles, not yet open. Raises CellError if it is unavailable."""
    settings = cell.calibration
    source = settings.joints or ("link" if cell.link is not None else "typed")
    if source != "link":
        if options.move:
            raise cell.error(
                ("calibration", "joints"), f"found {source!r} with --move, expected 'link'"
            )
        contact = options.kind == "tool" or options.instrument.measures in CONTACT_KINDS
        return TypedJoints(ask, contact) if source == "typed" else PlannedJoints()
    if cell.link is None:
        raise cell.error(("link",), "found nothing, expected the robot's address")
    if options.move and not cell.link.moves_arm:
        raise cell.error(
            ("link", "driver"),
            f"found {cell.link.driver!r}, which cannot move the arm; expected another for --move, "
            "or jog it",
        )
    from gapbridge.bridge.calibration.joints.link import LinkedJoints

    return LinkedJoints(cell, settings.settle, settings.speed, folder, options.move, SYSTEM)
