"""What JSON cannot hold becomes null, in arrays of any kind."""

from __future__ import annotations

import json

import numpy as np

from gapbridge.bridge.document.json_text import finite, json_text


def test_no_number_is_none_in_every_nesting_and_kind_of_array() -> None:
    document = {
        "floats": np.array([[1.5, np.nan], [np.inf, -2.0]]), "one": np.float64(-np.inf),
        "scalar": np.array(np.nan), "counts": np.array([1, 2]), "flags": np.array([True, False]),
        "names": np.array(["a", "b"]), "pair": (np.nan, {"x": 3.0}), "empty": np.zeros((0, 3)),
    }  # fmt: skip
    expected = {
        "floats": [[1.5, None], [None, -2.0]], "one": None, "scalar": None, "counts": [1, 2],
        "flags": [True, False], "names": ["a", "b"], "pair": [None, {"x": 3.0}], "empty": [],
    }  # fmt: skip
    assert finite(document) == expected
    assert json.loads(json_text(document)) == expected
