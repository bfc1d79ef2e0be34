"""No secret of a cell file gets into a recording, and nothing else is lost of it."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.bridge.recording.main import HIDDEN, redacted

SECRET = "s3cr3t-squeamish"


@pytest.mark.parametrize(
    "text",
    [
        f"web:\n  token: {SECRET}\n  port: 1\n",
        f"web: {{token: {SECRET}, port: 1}}\n",
        f'web: {{"token": "{SECRET}, with: a comma", port: 1}}\n',
        f"web:\n  token: '{SECRET} it''s long'  # the one from the safe\n  port: 1\n",
        f"web:\n  token: |\n    {SECRET}\n\n    {SECRET}\n  port: 1\n",
        f"web:\n  token: >-\n      {SECRET}\n      {SECRET}\n  port: 1\n",
        f"web:\n  Api_Key: {SECRET}\n  port: 1\n",
        f"web:\n  dashboard_password: {SECRET} and more words\n  port: 1\n",
    ],
)
def test_the_value_of_a_key_that_holds_a_secret_is_hidden_and_the_rest_stays(text: str) -> None:
    found = redacted(text)
    assert SECRET not in found
    assert HIDDEN in found
    section = yaml.safe_load(found)["web"]
    assert section["port"] == 1
    assert list(section) == list(yaml.safe_load(text)["web"])


def test_a_path_to_a_secret_is_none() -> None:
    text = "web: {token_file: /etc/gapbridge/token}\n"
    assert redacted(text) == text


def test_what_cannot_be_read_is_hidden_as_a_whole() -> None:
    assert redacted(f"web: {{token: {SECRET}\n  : [") == HIDDEN


def test_a_secret_that_is_referred_to_is_hidden_where_it_stands() -> None:
    assert SECRET not in redacted(f"first: &one {SECRET}\nweb: {{token: *one}}\n")
    assert SECRET not in redacted(f"web: {{tokens: [{SECRET}, {SECRET}]}}\nport: 1\n")


def test_a_cell_without_secrets_stays_as_it_is() -> None:
    text = (
        "# a cell\nrobot: {model: ur10e}   # keys: many\ntool: {tcp: {xyz: [0, 0, 0.18]}}\n"
        "link: {driver: ur_rtde, host: 192.168.0.10}\nlimits:\n  offset: 0.01\n"
    )
    assert redacted(text) == text


@given(st.from_regex(r"[A-Za-z0-9_.=/+-]{6,40}", fullmatch=True), st.sampled_from(["", "'", '"']))
def test_whatever_the_token_is(token: str, quote: str) -> None:
    head = "web:\n  "
    given_text = f"{head}token: {quote}{token}{quote}\n"
    assert redacted(given_text) in (f"{head}token: {HIDDEN}\n", HIDDEN)
