"""The catalogue: one form for every member."""

import importlib
import inspect

import numpy as np
import pytest
from test_equilibrium import SEVEN

from core.arm import arm_from_dh, builtin_rows
from core.effects import CATALOGUE, CHANNELS, Site, Term, effect_named
from core.errors import InputError

DH = {"ur10e": builtin_rows("ur10e")["dh"], "seven": SEVEN}
WITHOUT_UNIT = ("ft_gain", "link_inertia", "torque_constant")  # shares of what is there


@pytest.mark.parametrize("name", CATALOGUE)
def test_name_file_class_and_identifier_are_one(name):
    member = CATALOGUE[name]
    words = "".join(word.capitalize() for word in name.split("_"))
    assert (member.identifier, type(member).__name__) == (name, words)
    assert type(member).__module__ == f"core.effects.{name}"
    module = importlib.import_module(f"core.effects.{name}")
    assert getattr(module, words) is type(member)


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
    for told in member.reported(arm, term, np.diag((0.1 * scale) ** 2)):
        assert told.name.startswith(name)
        assert np.isfinite(told.value)
        assert told.std is not None
        assert 0 < told.std < np.inf
    assert all(told.std is None for told in member.reported(arm, term, None))


def test_an_unknown_effect_names_the_nearest():
    with pytest.raises(InputError, match=r"found 'axial_complience', .*did you mean 'axial_compl"):
        effect_named("axial_complience")
    assert effect_named("backlash") is CATALOGUE["backlash"]
    with pytest.raises(InputError, match="known: joint_offset"):
        effect_named("zzzz")
