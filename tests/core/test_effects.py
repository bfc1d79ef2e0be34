"""The catalogue: one form for every member."""

import importlib
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from test_equilibrium import SEVEN

from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_rows
from gapbridge.core.dynamics import predict_torque, predict_tracking, predict_wrench, with_pieces
from gapbridge.core.effects import CATALOGUE, CHANNELS, Effect, Site, Term, effect_named, ties_of
from gapbridge.core.errors import InputError
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of

DH = {"ur10e": builtin_rows("ur10e")["dh"], "seven": SEVEN}
WITHOUT_UNIT = ("ft_gain", "link_inertia", "load_friction", "torque_constant")  # shares


@pytest.mark.parametrize("name", CATALOGUE)
def test_name_file_class_and_identifier_are_one(name):
    member = CATALOGUE[name]
    phrase = "".join(word.capitalize() for word in name.split("_"))
    assert (member.identifier, type(member).__name__) == (name, phrase)
    folder = member.channels[0] if len(member.channels) == 1 else "load"
    assert type(member).__module__ == f"gapbridge.core.effects.{folder}.{name}"
    module = importlib.import_module(f"gapbridge.core.effects.{folder}.{name}")
    assert getattr(module, phrase) is type(member)


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_member_explains_itself(name):
    member = CATALOGUE[name]
    text = inspect.cleandoc(type(member).__doc__ or "")
    assert len(text) > 80
    assert text.endswith(".")
    assert member.motion
    assert member.channels
    assert set(member.channels) <= set(CHANNELS)


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("arm_name", DH)
def test_sites_and_parameters_are_finite_and_named_once(name, arm_name):
    member, arm = CATALOGUE[name], arm_from_dh(DH[arm_name])
    labels = []
    for site in member.sites(arm):
        assert site.joint is None or 1 <= site.joint <= arm.n
        for parameter in member.parameters(arm, site):
            assert np.isfinite(parameter.scale)
            assert parameter.scale > 0
            assert parameter.unit or name in WITHOUT_UNIT
            assert parameter.lower <= 0 < parameter.upper
            assert parameter.scale <= parameter.upper
            labels.append((member.label(site, parameter), site.order))
    assert labels
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("name", CATALOGUE)
def test_reported_values_carry_the_terms_and_their_spread(name):
    member, arm = CATALOGUE[name], arm_from_dh(DH["seven"])
    site = member.sites(arm)[0]
    site = Site(site.joint, site.order or (3.0 if name == "transmission_error" else None))
    scale = np.array([p.scale for p in member.parameters(arm, site)])
    term = Term(name, site, tuple(scale))
    for shown in member.reported(arm, term, np.diag((0.1 * scale) ** 2)):
        assert shown.name.startswith(name)
        assert np.isfinite(shown.value)
        assert shown.std is not None
        assert 0 < shown.std < np.inf
    assert all(shown.std is None for shown in member.reported(arm, term, None))


def test_an_unknown_effect_names_the_nearest():
    with pytest.raises(InputError, match=r"found 'axial_complience', .*did you mean 'axial_compl"):
        effect_named("axial_complience")
    assert effect_named("backlash") is CATALOGUE["backlash"]
    with pytest.raises(InputError, match="known: joint_offset"):
        effect_named("zzzz")


def _moving_rows(arm):
    """Return the motion of a log in which every joint moves both ways under a load."""
    t = np.arange(0, 4, 0.01)
    q = 0.8 * np.sin(t[:, None] * (1 + 0.2 * np.arange(arm.n)) + np.arange(arm.n))
    columns = {"timestamp": t, "actual_q": q, "target_q": q}
    return motion_of(Log("moving.csv", columns, arm.n))


def _at_rest(arm):
    rng = np.random.default_rng(0)
    loads = Loads(
        payload_mass=rng.uniform(1, 4, 20), payload_cog=rng.normal(0, 0.05, (20, 3)),
        wrench=rng.normal(0, 20, (20, 6)), temperature=rng.uniform(15, 45, (20, arm.n)),
        approach=rng.choice([-1.0, 1.0], (20, arm.n)),
    )  # fmt: skip
    return rng.uniform(-2, 2, (20, arm.n)), loads


def _predicted(channel, model, terms):
    if channel == "position":
        return model.with_terms(terms).predict(*_at_rest(model.arm)).position
    how = {"wrench": predict_wrench, "tracking": predict_tracking, "torque": predict_torque}
    return how[channel](model, with_pieces(model, _moving_rows(model.arm)), terms)


@pytest.mark.parametrize(
    ("name", "channel"), [(e, c) for e, member in CATALOGUE.items() for c in member.channels]
)
def test_every_member_changes_every_channel_that_it_declares(name, channel):
    member, arm = CATALOGUE[name], arm_from_dh(DH["ur10e"])
    tool = np.eye(4)
    tool[:3, 3] = [0.05, 0.02, 0.15]
    tilted = np.array([2.0, 1.0, -9.5])  # joint 1 holds something too
    cog = np.array([0.02, 0.0, 0.1])
    model = Model(arm, tool, payload_mass=3.0, payload_cog=cog, gravity=tilted)
    model = model.with_compliance([1e-5] * 6, [5e-6] * 6)
    plain = _predicted(channel, model, ())
    for site in member.sites(arm):
        place = Site(site.joint, 2.0 if member.periodic else None)
        values = tuple(p.scale for p in member.parameters(arm, place))
        moved = _predicted(channel, model, [Term(name, place, values)])
        assert np.abs(moved - plain).max() > 1e-8, (name, channel, site.joint)


@pytest.mark.parametrize("name", CATALOGUE)
def test_ties_are_mutual_declared_once_and_shown_in_a_common_channel(name):
    for other, data in ties_of(name).items():
        assert data
        assert ties_of(other)[name] == data
        assert not (name in CATALOGUE[other].equivalents and other in CATALOGUE[name].equivalents)
        assert {*CATALOGUE[name].channels} & {*CATALOGUE[other].channels}


def test_the_last_links_first_moment_and_the_loads_centre_are_the_same_under_one_load():
    arm, rng = builtin_arm("ur10e"), np.random.default_rng(1)
    q = rng.uniform(-2, 2, (40, arm.n))
    log = Log("poses.csv", {"actual_q": q}, arm.n)
    model = Model(arm, payload_mass=2.0, payload_cog=np.array([0.0, 0.0, 0.05]))
    motion = with_pieces(model, motion_of(log))
    nominal = predict_torque(model, motion)
    shift = np.array([0.02, -0.01, 0.0])  # flange axes: those of the last row's frame
    by_load = predict_torque(model, motion, [Term("payload_cog", Site(), tuple(shift))])
    moment = tuple(2.0 * shift)
    by_link = predict_torque(model, motion, [Term("link_cog", Site(arm.n), moment)])
    assert np.abs(by_load - nominal).max() > 0.1
    assert np.allclose(by_load, by_link, atol=1e-9)


@pytest.mark.parametrize("name", CATALOGUE)
def test_what_no_simulator_holds_says_what_to_do_instead(name):
    effect = CATALOGUE[name]
    in_chain = type(effect).shape is not Effect.shape
    asked = type(effect).simulator is not Effect.simulator
    assert in_chain or asked or effect.simulated_as or effect.simulator_advice


def test_each_effect_stands_on_the_page_of_conventions_in_the_order_in_which_it_acts():
    page = (Path(__file__).parents[2] / "docs" / "conventions.md").read_text(encoding="utf-8")
    table = page[page.index("## Signs") : page.index("## Torques and wrenches")]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(CATALOGUE)
    for channel in ("wrench", "tracking", "torque"):
        orders = [CATALOGUE[n].order for n in named if channel in CATALOGUE[n].channels]
        assert orders == sorted(orders)
