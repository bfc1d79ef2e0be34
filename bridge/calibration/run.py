"""One call of `gapbridge calibrate`: begin or go on, measure, fit, hand over."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from bridge.calibration.book import Book
from bridge.calibration.bringing import Bringing
from bridge.calibration.conversation import Conversation
from bridge.calibration.finish import finish
from bridge.calibration.folders import begun_entry, check_begun, session_folder
from bridge.calibration.foresight import Foresight
from bridge.calibration.instruments import make_instrument
from bridge.calibration.instruments.instrument import AnyInstrument, Surroundings
from bridge.calibration.journal import Journal
from bridge.calibration.order import Order
from bridge.calibration.pace import seconds_left
from bridge.calibration.plan_document import write_poses
from bridge.calibration.planning import effects_of, loads_of, metrology_of, planned, space_of
from bridge.calibration.stand import JointSource, PlannedJoints, TypedJoints
from bridge.calibration.talk import InputEnded, Talk, Word
from bridge.calibration.words import duration, load_text, millimetres, parameter
from bridge.cell import Cell
from core.calibration.plan import Plan
from core.errors import CellError, LinkError

Array = NDArray[np.float64]


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
        except Word:  # quit
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
    talk.say(f"Calibration of {cell.path}: {cell.arm.name}", "bold")
    if book.begun:
        check_begun(book.begun, cell, order, folder)
        _tell_resumed(talk, book, folder)
    else:
        book.add("begun", **begun_entry(cell, order))
        talk.say(f"new session in {folder}")
    if book.plan is None:
        _make_plan(cell, order, talk, book)
    assert book.plan is not None
    if order.plan_only:
        talk.say(f"every stop with its joints: {folder / 'poses.csv'}")
        talk.say(f"go on with: {_command(cell, order, book)}")
        return
    if book.next is not None:
        _measure(cell, order, talk, book)
    finish(cell, order, talk, book)


def _make_plan(cell: Cell, order: Order, talk: Talk, book: Book) -> None:
    with talk.waiting("planning") as tell:
        plan = planned(cell, order, lambda text, share: tell(f"planning: {text} ({share:.0%})"))
    book.keep_plan(plan)
    write_poses(plan, book.journal.path.parent / "poses.csv")
    _tell_plan(talk, plan, book, cell.calibration.minutes_per_load)


def _tell_plan(talk: Talk, plan: Plan, book: Book, minutes: float) -> None:
    fitted = sum(not p.held_out and not p.repeat for p in plan.poses)
    held = sum(p.held_out for p in plan.poses)
    again = sum(p.repeat > 0 for p in plan.poses)
    talk.say(
        f"plan: {fitted} poses to fit, {held} to verify, {again} once more for the repeatability: "
        f"{len(plan.poses)} stops, {duration(seconds_left(book, minutes) + plan.travel)}"
    )
    for i, load in enumerate(plan.loads):
        talk.say(f"  load {i + 1}: {load_text(load)}")
    expected = plan.expected
    talk.say(
        f"expected: the predicted TCP known to {millimetres(expected.tcp_std)} (1 sigma over the "
        f"workspace and loads; {millimetres(expected.tcp_std_worst)} at worst)"
    )
    told = ", ".join(f"{n}: {millimetres(s)}" for n, s in plan.bought)
    talk.say(f"  what n poses buy: {told}")
    weak = [
        f"{n} ±{parameter(s, u)}"
        for n, u, s, p in zip(
            expected.names, expected.units, expected.std, expected.prior, strict=True
        )
        if not np.isfinite(s) or s > p
    ]
    if weak:
        talk.say(f"  these poses hardly tell: {', '.join(weak)}")
    for note in plan.notes:
        talk.say(f"  note: {note}")


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


def _measure(cell: Cell, order: Order, talk: Talk, book: Book) -> None:
    given, assumed = cell.calibration, order.instrument
    metrology = metrology_of(cell, assumed)
    with ExitStack() as stack:
        around = Surroundings(
            ask=lambda question: talk.ask(f"  {question}"),
            link_host=str(getattr(cell.link, "host", "") or ""),
            since=float(book.begun["time"]),
        )
        with talk.waiting("reaching the instrument"):
            instrument = stack.enter_context(make_instrument(assumed, around))
        joints = _joints(cell, order, around, book.journal.path.parent)
        with talk.waiting("reaching the arm"):
            stack.enter_context(joints)
        talk.say(f"instrument: {instrument.name}; joints: {_told(joints, order)}")
        talk.say("at every question: Enter goes on, `undo`, `back`, `skip`, `quit`, `?`")
        bringing = Bringing(
            talk, book, joints, _clear(cell, assumed.measures), given.speed,
            given.minutes_per_load, _waits(instrument),
        )  # fmt: skip
        foresight = Foresight(
            cell.model, metrology, assumed.measures, metrology.sigma, effects_of(cell),
            loads_of(cell),
        )  # fmt: skip
        Conversation(
            talk, book, bringing, instrument, foresight, metrology.sigma, given.samples
        ).lead()


def _waits(instrument: AnyInstrument) -> bool:
    """Return whether reading the instrument waits for the person, or for what is exported."""
    return instrument.manual or instrument.settings.kind in ("file", "folder", "sphere")


def _clear(cell: Cell, kind: str) -> Callable[[Array], Array]:
    space = space_of(cell, kind)
    return lambda q: np.asarray(space.clear(q), dtype=float)


def _joints(cell: Cell, order: Order, around: Surroundings, folder: Path) -> JointSource:
    """Return how joints are known. Raises CellError where the cell does not fit the order."""
    given = cell.calibration
    source = given.joints or ("link" if cell.link is not None else "typed")
    if source != "link":
        if order.move:
            raise CellError(
                f"{cell.path}: calibration.joints: found {source!r} with --move, expected 'link'"
            )
        return TypedJoints(around.ask) if source == "typed" else PlannedJoints()
    if cell.link is None:
        raise CellError(f"{cell.path}: link: found nothing, expected the robot's address")
    if order.move and not cell.link.moves_arm:
        raise CellError(
            f"{cell.path}: link.driver: found {cell.link.driver!r}, which cannot move the arm; "
            "expected another for --move, or jog it"
        )
    from bridge.calibration.linked_joints import LinkedJoints

    return LinkedJoints(cell, given.settle, given.speed, folder, order.move)


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
