"""Names of parameters in words, and figures as a certificate reports them."""

import math

import pytest

from gapbridge.bridge.document.notes import note_text
from gapbridge.bridge.document.numbers import decimals_of, estimate_texts, fixed, load_title, mm
from gapbridge.bridge.report.labels import parameter_title, sentence
from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason


def test_every_parameter_that_a_session_can_find_has_a_title_of_its_own():
    effects = [e for e, effect in CATALOGUE.items() if effect.calibratable]
    names = Parameters.of_effects(Model(builtin_arm("ur10e")), effects).names
    words = [parameter_title(name) for name in names]
    assert len(set(words)) == len(names)
    assert not [w for w in words if "_" in w or w.endswith((":", "("))]


def test_a_few_names_as_they_are_shown():
    assert parameter_title("joint_offset_3") == "zero of joint 3"
    assert parameter_title("link_geometry_2_alpha") == "twist alpha of link 2"
    assert parameter_title("tool_frame_rx") == "tool turn about x"
    assert parameter_title("payload") == "mass of the load beyond the declared one"
    assert parameter_title("made_up") == "made_up"


def test_reports_name_parameters_by_their_titles_and_commands_by_their_public_names():
    note = Note(Reason.ONLY_TOGETHER, ("joint_offset_1", ("link_geometry_3_d", "backlash_2")))
    text = "{}: these readings determine it only together with {}, {}"
    assert note_text(note) == text.format("joint_offset_1", "link_geometry_3_d", "backlash_2")
    titles = "zero of joint 1", "offset d of link 3", "play of joint 2"
    assert note_text(note, parameter_title) == text.format(*titles)


def test_a_sentence_begins_with_a_capital_and_ends_with_a_stop():
    assert sentence("the error falls") == "The error falls."
    assert sentence("Done!") == "Done!"


@pytest.mark.parametrize(("length", "text"), [
    (0.0, "0.000 mm"), (5.4e-6, "0.0054 mm"), (41.3e-6, "0.041 mm"), (1.5894e-3, "1.589 mm"),
    (0.0314159, "31.42 mm"), (-2e-5, "−0.020 mm"), (math.nan, "unknown"),
])  # fmt: skip
def test_lengths_are_shown_to_the_micrometre(length, text):
    assert mm(length) == text


def test_a_value_has_the_digits_of_its_deviation():
    e = Estimate("joint_offset_2", 7.99412e-4, 1.26e-5, "rad")
    assert estimate_texts(e) == ("0.799", "0.775 to 0.824", "0.013", "mrad")
    assert decimals_of(0.0) == decimals_of(math.inf) == 3


def test_zero_has_no_minus_sign():
    assert fixed(-1e-9, 3) == "0.000"
    assert fixed(-0.0126, 2) == "−0.01"


def test_a_loads_name_that_only_says_its_mass_is_left_out():
    assert load_title(8.0, "8 kg") == "8 kg"
    assert load_title(1.25, "gripper") == "1.25 kg (gripper)"
