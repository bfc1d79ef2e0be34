"""The report of every verdict: one file, its figures, no markup from user input."""

import re
from dataclasses import replace

import numpy as np
import pytest
from report_cases import CASES, diagnosed

from gapbridge.bridge.document.drawing import Text
from gapbridge.bridge.document.numbers import decimals_of, likelihood, number, percent, with_unit
from gapbridge.bridge.document.skeleton import skeleton
from gapbridge.bridge.report import SECTIONS, report_text
from gapbridge.bridge.report.answer import picture, sentences
from gapbridge.bridge.report.labels import (
    VERDICTS,
    effect_title,
    joint_list,
    listed,
    quantity_title,
    quantity_unit,
)
from gapbridge.bridge.report.material import SHOWN, shares, thinned, unexplained
from gapbridge.bridge.report.parameters import measurements_table
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.causes import Considered, Outcome
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.diagnosis.finding import Check, Withdrawal
from gapbridge.core.diagnosis.separation import Measurement
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.model import Model
from gapbridge.core.rotation import rpy_matrix, transform


@pytest.fixture(scope="module", params=list(CASES))
def case(request):
    return request.param, diagnosed(request.param)


def test_every_verdict_is_among_the_cases():
    assert {diagnosed(name).diagnosis.verdict for name in CASES} == set(VERDICTS)


def test_a_report_is_one_small_file_with_every_section(case):
    name, c = case
    text = report_text(c.diagnosis, "Cell 7", c.log, c.model)
    assert len(text.encode()) < 2e6
    for section in SECTIONS:
        shown = section.key != "slips" or name == "slip"
        assert (f'<section id="{section.key}"><h2>{section.title}</h2>' in text) is shown


def test_a_measurement_names_the_last_motion_of_each_joint():
    wanted = Measurement((0.0,) * 3, 2.0, ("backlash",), 3.0, approach=(1, -1, 0))
    table = measurements_table((wanted,), 1)
    assert table.rows[0][table.heads.index("last motion of each joint")] == "+ − 0"


def test_nothing_is_loaded_from_outside(case):
    _, c = case
    text = report_text(c.diagnosis, "Cell 7", c.log, c.model)
    assert not re.findall(r"<(?:script|img|iframe|link)[^>]*(?:src|href)=[\"']?https?:", text)


def test_the_figures_of_the_diagnosis_stand_in_the_report(case):
    _, c = case
    text = report_text(c.diagnosis, "Cell 7", c.log, c.model)
    for channel in c.diagnosis.channels:
        assert with_unit(channel.gap_rms, channel.unit) in text
        for cause in channel.causes:
            assert CATALOGUE[cause.effect].title in text
            for parameter in cause.parameters:
                assert f"<code>{parameter.name}</code>" in text
        for considered in channel.considered:
            assert f"<code>{considered.effect}</code>" in text
    for hidden in c.diagnosis.not_observable:
        assert ", ".join(hidden.needs) in text


def test_text_of_the_user_cannot_become_markup():
    c = diagnosed("no gap")
    name = '<script>alert(1)</script> & "quotes"'
    text = report_text(c.diagnosis, name, c.log, c.model)
    assert "<script>alert(1)" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp;" in text


def test_the_same_diagnosis_gives_the_same_file():
    c = diagnosed("no gap")
    one = report_text(c.diagnosis, "Cell", c.log, c.model)
    assert one == report_text(c.diagnosis, "Cell", c.log, c.model)


def test_shares_add_up_to_one(case):
    for channel in case[1].diagnosis.channels:
        part = shares(channel)
        assert part.explained + part.noise + part.unexplained == pytest.approx(1.0)
        assert min(part.explained, part.noise, part.unexplained) >= 0


def test_no_gap_at_all_is_not_called_explained():
    channel = replace(diagnosed("no gap").diagnosis.channels[0], gap_rms=0.0)
    assert shares(channel).explained == 0


def test_what_fits_and_was_withdrawn_is_named_where_there_is_no_cause():
    """A force sensor's zero under one attitude is in the catalogue; a load is as likely."""
    channel = diagnosed("unexplained").diagnosis.channels[0]
    assert channel.verdict is Verdict.UNEXPLAINED
    why = Withdrawal(Check.SEPARATED, "payload")
    fits = Considered("ft_bias", 0.99, 1.0, Outcome.WITHDRAWN, withdrawal=why)
    no = Considered("ft_gain", 0.0, 0.0, Outcome.NOT_NEEDED)
    (_, sentence, _) = sentences(replace(channel, considered=(no,)))
    assert "its cause is not in the catalogue" in sentence
    (_, sentence, _) = sentences(replace(channel, considered=(fits, no)))
    assert effect_title("ft_bias") in sentence
    assert effect_title("ft_gain") not in sentence
    assert "not in the catalogue" not in sentence


def test_what_a_quantity_predicts_is_not_called_noise():
    channel = diagnosed("partly explained").diagnosis.channels[0]
    blind = replace(channel, noise_floor_rms=channel.gap_rms, unexplained_rms=0.0)
    assert shares(blind).unexplained > 0
    assert unexplained(blind) > 0


def test_a_path_to_a_cell_is_reported_by_its_file():
    c = diagnosed("no gap")
    text = report_text(c.diagnosis, "a/b/line4.yaml", c.log, c.model)
    assert "<h1>line4: " in text


@pytest.mark.parametrize("size", [4.35e-9, 2.8e-5, 0.0123])
def test_a_figure_stands_beside_the_name_of_its_bar(size):
    channel = replace(diagnosed("explained").diagnosis.channels[0], gap_rms=size, unit="rad")
    written = [shape for shape in picture(channel).shapes if isinstance(shape, Text)]
    name, figure = (next(t for t in written if t.text == "before"), written[2])
    wide = 0.64 * figure.size  # of a letter, as Chromium draws it
    assert figure.text == with_unit(size, "rad")
    assert figure.x - wide * len(figure.text) > name.x + wide * len(name.text)


def test_the_drawn_arm_ends_at_the_rigid_tcp():
    model = Model(builtin_arm("ur10e"), transform(rpy_matrix(np.zeros(3)), np.array([0, 0, 0.2])))
    q = np.array([0.3, -1.2, 1.1, -0.4, 0.9, 0.2])
    points = skeleton(model, q)
    assert points.shape == (model.arm.n + 3, 3)
    np.testing.assert_allclose(points[-1], model.rigid_pose(q[None]).position[0], atol=1e-12)


def test_long_logs_are_thinned_but_keep_their_worst_samples():
    score = np.random.default_rng(1).random(12000)
    keep = thinned(score)
    assert len(keep) <= SHOWN
    assert int(np.argmax(score)) in keep
    assert len(thinned(score[:20])) == 20


def test_every_effect_of_the_catalogue_has_plain_text():
    assert all(effect.title for effect in CATALOGUE.values())


@pytest.mark.parametrize(("text", "wanted"), [
    (with_unit(4.1e-4, "m"), "0.410 mm"), (with_unit(-2.5e-3, "rad"), "−2.50 mrad"),
    (with_unit(None, "m"), "unknown"), (with_unit(12.0, "Nm"), "12.0 Nm"), (number(0.0), "0"),
    (percent(-0.001), "0 %"), (likelihood(0.99999), "over 99.9 %"), (joint_list((2, 3)),
     "joints 2 and 3"), (listed(["a", "b", "c"], "or"), "a, b or c"),
    (quantity_title("actual_q_2"), "angle of joint 3"),
    (quantity_title("joint_temperatures_0"), "temperature of joint 1"),
])  # fmt: skip
def test_values_are_reported_in_the_units_that_people_use(text, wanted):
    assert text == wanted


def test_an_interval_is_reported_with_two_digits_of_its_width():
    assert (decimals_of(0.0123), decimals_of(1.23), decimals_of(250.0)) == (3, 1, 0)


def test_an_outside_torque_is_not_in_newtons():
    force, torque = "actual_TCP_force_0", "actual_TCP_force_4"
    assert (quantity_title(force), quantity_unit(force)) == ("outside force x", ("N", 1.0))
    assert (quantity_title(torque), quantity_unit(torque)) == (
        "outside torque about y", ("Nm", 1.0),
    )  # fmt: skip
