"""docs/catalogue.md agrees with the docstrings of the effects."""

import inspect

from benchmarks.evidence.catalogue_page import PAGE, catalogue_page, main
from gapbridge.bridge.cli.cell.explain import explanation_text
from gapbridge.core.effects import CATALOGUE


def test_the_committed_page_is_fresh():
    assert PAGE.read_text(encoding="utf-8") == catalogue_page(), (
        "run python -m benchmarks.evidence.catalogue_page"
    )


def test_every_effect_stands_on_the_page_with_its_docstring():
    page = catalogue_page()
    for name, effect in CATALOGUE.items():
        assert f"### {name}\n\n{inspect.getdoc(effect)}\n" in page


def test_the_page_is_written_where_it_is_asked_for(tmp_path):
    assert main([str(tmp_path / "page.md")]) == 0
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == catalogue_page()


def test_parameters_that_only_some_joints_have_are_listed():
    line = "`a` (m), `d` (m), `alpha` (rad), `beta` (rad, not of every joint)"
    assert f"- parameters: {line}\n" in catalogue_page()
    assert "beta (rad, not of every joint)" in explanation_text(CATALOGUE["link_geometry"])
