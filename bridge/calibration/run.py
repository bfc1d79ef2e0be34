"""One call of `gapbridge calibrate`: begin or go on, measure, fit, hand over."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.format import load_text
from gapbridge.bridge.calibration.instruments.instrument import (
    AnyInstrument,
    ReadingError,
    Surroundings,
)
from gapbridge.bridge.calibration.jobs.job import Job
from gapbridge.bridge.calibration.jobs.table import make_job
from gapbridge.bridge.calibration.joints.joint_source import JointSource, PlannedJoints
from gapbridge.bridge.calibration.options import Order
from gapbridge.bridge.calibration.planning import loads_of, metrology_of, space_of, with_loads
from gapbridge.bridge.calibration.session.folders import begun_entry, check_begun, session_folder
from gapbridge.bridge.calibration.session.joint_sources import make_joints
from gapbridge.bridge.calibration.session.journal import Journal
from gapbridge.bridge.calibration.session.measuring import Conversation
from gapbridge.bridge.calibration.session.plan_document import write_poses
from gapbridge.bridge.calibration.session.positioning import Bringing
from gapbridge.bridge.calibration.session.prompt import InputEnded, Talk, Word
from gapbridge.bridge.calibration.session.session import Book
from gapbridge.bridge.cell import Cell
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import CellError, LinkError

Array = NDArray[np.float64]
TITLES = {
    "whole": "Calibration of",
    "verify": "Verification of",
    "payload": "Load and force sensor of",
    "tool": "Tool of",
}


def run_session(cell: Cell, order: Order) -> None:
    """Do what a person has asked for. Raises InputError, RunError; click's Exit after Ctrl-C."""
    folder = session_folder(cell, order)
    journal = Journal(folder)
    talk = Talk()
    with journal:
        book = Book.of(journal)
        talk.note = lambda text: book.add("note", text=text)
        try:
            _lead(cell, order, talk, book)
        except Word as word:
            if word.word == "undo" and book.taken:  # at the last question
                book.add("undo", stop=book.taken[-1].stop)
                talk.say(
                    f"took back the last reading; stop {(book.next or 0) + 1} is to be measured"
                )
            talk.say(_how_to_go_on(cell, order, book))
        except InputEnded:
            talk.say()
            talk.say(f"the input ended; {_how_to_go_on(cell, order, book)}")
        except KeyboardInterrupt:
            talk.say()
            talk.say(f"interrupted; {_how_to_go_on(cell, order, book)}")
            raise click.exceptions.Exit(1) from None
        except LinkError:
            talk.say(_how_to_go_on(cell, order, book))
            raise


def _lead(cell: Cell, order: Order, talk: Talk, book: Book) -> None:
    folder = book.journal.path.parent
    talk.say(f"{TITLES[order.kind]} {cell.path}: {cell.arm.name}", "bold")
    job = make_job(cell, order, talk, book)
    if book.begun:
        check_begun(book.begun, cell, order, folder)
        _tell_resumed(talk, book, folder)
    else:
        book.add("begun", **begun_entry(cell, order))
        talk.say(f"new session in {folder}")
    around = Surroundings(
        ask=lambda question: talk.ask(f"  {question}"),
        link_host=str(getattr(cell.link, "host", "") or ""),
        since=float(book.begun["time"]),
    )
    with ExitStack() as stack:
        joints = make_joints(cell, order, around.ask, folder)
        instrument = None
        if not order.plan_only and (book.plan is None or book.next is not None):
            instrument = job.instrument(around)  # before the plan: what is missing is told at once
            with talk.waiting("reaching the instrument"):
                stack.enter_context(instrument)
        if job.from_here and (book.plan is None or book.next is not None):
            _open(talk, stack, joints)
        if book.plan is None:
            _make_plan(job, joints)
        else:
            _tell_old_plan(job)
        if order.plan_only:
            talk.say(f"every stop with its joints: {folder / 'poses.csv'}")
            talk.say(f"go on with: {_command(cell, order, book)}")
            return
        if book.next is not None:
            assert instrument is not None
            if not job.from_here:
                _open(talk, stack, joints)
            _measure(job, joints, instrument)
    job.finish()


def _open(talk: Talk, stack: ExitStack, joints: JointSource) -> None:
    with talk.waiting("reaching the arm"):
        stack.enter_context(joints)


def _begin(job: Job, joints: JointSource) -> Array:
    """Return where the arm stands before the plan is made (n,), rad."""
    n = job.cell.arm.n
    here = joints.now()
    while here is None:
        try:
            told = joints.stand(PlannedPose(0, np.full(n, np.nan), 0, np.zeros(n))).q
        except ReadingError as error:
            job.talk.warn(str(error))
            continue
        if np.isfinite(told).all():
            here = told
        else:
            job.talk.warn("found nothing, expected where the arm stands now: the plan begins there")
    return here


def _make_plan(job: Job, joints: JointSource) -> None:
    talk, book = job.talk, job.book
    begin = _begin(job, joints) if job.from_here else None
    with talk.waiting("planning") as tell:
        plan = job.plan(begin, lambda text, share: tell(f"planning: {text} ({share:.0%})"))
    book.keep_plan(plan)
    write_poses(plan, job.folder / "poses.csv")
    job.tell_plan(plan)


def _tell_old_plan(job: Job) -> None:
    """Tell the plan of an earlier call where it is asked for, and that it stays."""
    if job.order.poses is not None:
        job.talk.warn("this session has its plan: --poses counts for a new one")
    if job.order.plan_only and job.book.plan is not None:
        job.tell_plan(job.book.plan)


def _tell_resumed(talk: Talk, book: Book, folder: Path) -> None:
    count = len(book.stops)
    done = count - book.left
    talk.say(f"going on with the session in {folder}: {done} of {count} stops are measured")
    if book.journal.torn:
        talk.say("  the last line of its journal was torn by a break, before it counted")
    if book.taken:
        talk.say(f"  the last reading kept: stop {book.taken[-1].stop + 1}")
    if book.mounted is not None and book.plan is not None and book.next is not None:
        talk.say(f"  on the flange: {load_text(book.plan.loads[book.mounted])}")


def _measure(job: Job, joints: JointSource, instrument: AnyInstrument) -> None:
    talk, given, order = job.talk, job.cell.calibration, job.order
    if instrument.seats and order.move:
        raise CellError(
            f"{job.cell.path}: calibration.instrument.kind: found {order.instrument.kind!r} with "
            "--move, expected another: the tool is brought onto something by hand"
        )
    if instrument.seats and isinstance(joints, PlannedJoints):
        raise CellError(
            f"{job.cell.path}: calibration.joints: found 'planned' with an instrument of kind "
            f"{order.instrument.kind!r}, expected 'link' or 'typed': the joints are the reading"
        )
    talk.say(f"instrument: {instrument.name}; joints: {_told(joints, order)}")
    talk.say("at every question: Enter goes on, `undo`, `back`, `skip`, `quit`, `?`")
    bringing = Bringing(talk, job.book, joints, instrument, _clear(job), given)
    sigma = metrology_of(job.cell, order.instrument).sigma
    Conversation(talk, job.book, bringing, instrument, job.foresight(), sigma, given.samples).lead()


def _clear(job: Job) -> Callable[[Array], Array]:
    space = with_loads(space_of(job.cell, "position"), loads_of(job.cell))
    return lambda q: np.asarray(space.clear(q), dtype=float)


def _told(joints: JointSource, order: Order) -> str:
    if joints.watches:
        return "from the controller" + (", which Gapbridge drives" if order.move else "")
    return "as planned" if isinstance(joints, PlannedJoints) else "typed in degrees"


def _how_to_go_on(cell: Cell, order: Order, book: Book) -> str:
    done = len(book.stops) - book.left
    kept = f"{done} of {len(book.stops)} stops are measured and kept; " if book.stops else ""
    return f"{kept}go on with: {_command(cell, order, book)}"


def _command(cell: Cell, order: Order, book: Book) -> str:
    words = ["gapbridge", "calibrate", str(cell.path), "--session", str(book.journal.path.parent)]
    flags = {"verify": "--verify", "payload": "--payload-only", "tool": "--tool-only"}
    words += [flags[order.kind]] if order.kind in flags else []
    words += ["--move"] if order.move else []
    words += ["--apply", str(order.new_cell)] if order.new_cell else []
    return shlex.join(words)
