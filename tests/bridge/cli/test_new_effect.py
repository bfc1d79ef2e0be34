"""A new effect is one file and one line: nothing else changes, and the whole program knows it."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_runs import CELL, cell_in, columns_of, gapbridge, log_in, measured, names, poses_and_loads
from cli_runs import table_of as read

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.report.labels import effect_title
from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import Compensator
from gapbridge.core.dynamics import predict_torque, predict_tracking, predict_wrench, with_pieces
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of
from gapbridge.core.state import RobotState
from gapbridge.drivers.ft_sensor.joined import TcpForce

FILE = '''
"""A made-up effect."""

import numpy as np

from gapbridge.core.effects.effect import JointEffect, Parameter


class {name}(JointEffect):
    """Something that no catalogue has: {identifier}."""

    identifier = "{identifier}"
    title = "something new"
    channels = ("{channel}",)
    motion = "anything that moves"

    def parameters(self, arm, site):
        return (Parameter("", "{unit}", {scale}),)

{hook}
'''
HOOKS = {
    "position": ("CogWheel", "cog_wheel", "rad", 3e-4, '''
    def condition(self, term, arm, rows, loads, q):
        i = term.site.joint - 1
        rows.q[:, i] += term.values[0] * np.sign(np.sin(5 * q[:, i]))
'''),
    "wrench": ("CrossTalk", "cross_talk", "Nm/N", 0.02, '''
    def sense(self, term, arm, wrench, motion):
        result = wrench.copy()
        result[:, 5] += term.values[0] * wrench[:, term.site.joint - 1]
        return result
'''),
    "tracking": ("ServoRipple", "servo_ripple", "rad", 1e-3, '''
    def settle(self, term, arm, q, held, approach):
        result, i = q.copy(), term.site.joint - 1
        result[:, i] += term.values[0] * np.sign(np.sin(9 * q[:, i]))
        return result
'''),
    "torque": ("Cogging", "cogging", "Nm", 1.0, '''
    def drive(self, term, arm, torque, motion):
        result, i = torque.copy(), term.site.joint - 1
        result[:, i] += term.values[0] * np.sin(14 * motion.q[:, i])
        return result
'''),
}  # fmt: skip
PREDICT = {"wrench": predict_wrench, "tracking": predict_tracking, "torque": predict_torque}
SETPOINT = ("tracking", "compensate")
COLUMN = {"wrench": "ft_raw_wrench", "tracking": "actual_q", "torque": "actual_current_as_torque"}
SHOWN_AT = {"wrench": "_5", "tracking": "_2", "torque": "_2"}
NOISE = {"wrench": 0.05, "tracking": 2e-5, "torque": 0.05}
LOADED = CELL + "payload: {mass: 4.0, cog: [0.0, 0.02, 0.1]}\n"


@pytest.fixture(params=HOOKS)
def channel(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write the effect's file and put its line into the table."""
    name, identifier, unit, scale, hook = HOOKS[request.param]
    path = tmp_path / f"{identifier}.py"
    path.write_text(
        FILE.format(name=name, identifier=identifier, channel=request.param, unit=unit,
                    scale=scale, hook=hook), encoding="utf-8")  # fmt: skip
    spec = importlib.util.spec_from_file_location(identifier, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, identifier, module)
    spec.loader.exec_module(module)
    monkeypatch.setitem(CATALOGUE, identifier, getattr(module, name)())
    return str(request.param)


def truth_of(channel: str) -> tuple[Model, Term]:
    _, identifier, _, scale, _ = HOOKS[channel]
    term = Term(identifier, Site(3), (2 * scale,))
    return load_model().with_terms([term]), term


def load_model() -> Model:
    return Model(builtin_arm("ur10e"), payload_mass=4.0, payload_cog=np.array([0.0, 0.02, 0.1]))


def log_of(channel: str, truth: Model, folder: Path) -> Path:
    """Return a log that shows the channel, the new effect in it."""
    if channel == "position":
        q, loads = poses_and_loads(80)
        return log_in(folder, columns_of(q, loads) | measured(truth, q, loads, noise=2e-5))
    rng = np.random.default_rng(3)
    t = np.arange(0, 24, 0.01)
    turn = 2 * np.pi * rng.uniform(0.1, 0.5, (6, 3))
    wave = (0.6 / turn)[None] * np.sin(t[:, None, None] * turn + rng.uniform(0, 6, (6, 3)))
    q = np.add(wave.sum(axis=2), [0.0, -1.2, 1.5, -1.8, -1.5, 0.0])
    motion = motion_of(Log("truth", {"timestamp": t, "actual_q": q, "target_q": q}, 6))
    value = PREDICT[channel](truth, with_pieces(truth, motion))
    value = value + NOISE[channel] * rng.standard_normal(value.shape)
    columns = {"timestamp": t} | dict(zip(names("target_q", 6), q.T, strict=True))
    columns |= dict(zip(names("actual_q", 6), q.T, strict=True))
    return log_in(folder, columns | dict(zip(names(COLUMN[channel], 6), value.T, strict=True)))


def test_it_is_explained_found_applied_and_predicted(channel: str, tmp_path: Path) -> None:
    truth, term = truth_of(channel)
    answer = gapbridge("explain", term.effect)
    assert answer.code == 0
    assert f"shows in: {channel}" in answer.out
    assert effect_title(term.effect) == "something new"
    cell, new, file = cell_in(tmp_path, LOADED), tmp_path / "new.yaml", tmp_path / "d.json"
    log = log_of(channel, truth, tmp_path)
    answer = gapbridge("diagnose", log, "--cell", cell, "--json", file, "--apply", new)
    assert answer.code == 0, answer.err
    reported = json.loads(file.read_text(encoding="utf-8"))
    (own,) = [c for c in reported["channels"] if c["channel"] == channel]
    (cause,) = [c for c in own["causes"] if c["effect"] == term.effect]
    assert cause["joints"] == [3]
    (value,) = cause["parameters"]
    assert value["name"] == f"{term.effect}_3"
    assert abs(value["value"] - term.values[0]) < 0.05 * term.values[0]
    applied = load_cell(new).model
    assert [t.effect for t in applied.terms] == [c["effect"] for c in own["causes"]]
    before, after = load_cell(cell).model, applied
    for command, column in (("predict", "predicted_position_0"), ("compensate", "corrected_q_2")):
        tables = []
        for which in (cell, new):
            assert gapbridge(command, log, "--cell", which, "--out", tmp_path / "t.csv").code == 0
            head, table = read(tmp_path / "t.csv")
            tables.append(table[:, head.index(column)])
        changed = bool(np.abs(tables[0] - tables[1]).max() > 1e-6)
        # where encoders are known, what servos do plays no part in where the tool is
        assert changed is (channel == "position" or (channel, command) == SETPOINT)
    if channel != "position":
        _predicted(channel, log, (cell, new), tmp_path / "t.csv")
    _live(channel, before, after, truth)


def _predicted(channel: str, log: Path, cells: tuple[Path, Path], out: Path) -> None:
    """Check that what a channel shows is predicted down to the noise once the effect is known."""
    head, table = read(log)
    measured_there = table[:, head.index(COLUMN[channel] + SHOWN_AT[channel])]
    rms = []
    for cell in cells:
        answer = gapbridge("predict", log, "--channels", "--cell", cell, "--out", out)
        assert answer.code == 0, answer.err
        head, table = read(out)
        own = head.index(
            f"predicted_{'q' if channel == 'tracking' else channel}{SHOWN_AT[channel]}"
        )
        rms.append(float(np.sqrt(np.nanmean((table[:, own] - measured_there) ** 2))))
    assert rms[0] > 3 * NOISE[channel]
    assert rms[1] < 1.5 * NOISE[channel]


def _live(channel: str, before: Model, after: Model, truth: Model) -> None:
    """Check that what is written, or read, in the loop knows the effect."""
    q = np.array([0.1, -1.2, 1.4, -1.8, -1.5, 0.2])
    if channel == "position":
        wanted = before.rigid_pose(q[None]).position
        off = [
            np.linalg.norm(truth.predict(Compensator(m).correct(q).q[None]).position - wanted)
            for m in (before, after)
        ]
        assert off[1] < 0.1 * off[0]
    if channel == "tracking":
        rests = [truth.settled(Compensator(m).correct(q).q[None])[0] for m in (before, after)]
        assert np.abs(rests[1] - q).max() < 0.1 * np.abs(rests[0] - q).max()
    if channel == "wrench":
        raw = predict_wrench(truth, with_pieces(truth, _standing(q)))[0]
        state = RobotState(0.0, 0.0, q, np.zeros(6), q, np.zeros(6))
        wrench = [np.linalg.norm(TcpForce(m).of(raw, state)) for m in (before, after)]
        assert wrench[1] < 0.1 * wrench[0]
    if channel == "torque":
        motion = with_pieces(before, _standing(q))
        more = predict_torque(after, motion) - predict_torque(before, motion)
        true = predict_torque(truth, motion) - predict_torque(before, motion)
        np.testing.assert_allclose(more, true, rtol=0.1)


def _standing(q: np.ndarray) -> Motion:
    """Return the motion of a log of one pose at rest."""
    return motion_of(Log("rest", {"actual_q": q[None], "target_q": q[None]}, 6))


def test_it_changes_what_its_channel_predicts(channel: str, tmp_path: Path) -> None:
    truth, term = truth_of(channel)
    if channel == "position":
        q, loads = poses_and_loads(5)
        plain, moved = (m.predict(q, loads).position for m in (load_model(), truth))
    else:
        t = np.arange(0, 2, 0.01)
        q = np.sin(t[:, None] + np.arange(6))
        motion = motion_of(Log("t", {"timestamp": t, "actual_q": q, "target_q": q}, 6))
        plain, moved = (
            PREDICT[channel](m, with_pieces(m, motion)) for m in (load_model(), truth)
        )  # fmt: skip
    assert np.abs(moved - plain).max() > 0.5 * term.values[0] * (channel != "position")
    assert np.abs(moved - plain).max() > 0
