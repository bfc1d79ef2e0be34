"""A configuration's files are read once; who gets them handed on reads those and no others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gapbridge.core.files import read_bytes, read_text, recorded

CODE = """
import pickle, sys
from pathlib import Path
from gapbridge.core.files import is_file, read_bytes, read_only_given, read_text
read_only_given(pickle.loads(sys.stdin.buffer.read()))
path, link, other = map(Path, sys.argv[1:])
assert read_text(path) == read_text(link) == "as it was", read_text(path)
assert is_file(path) and not is_file(other)
try:
    read_bytes(other)
except FileNotFoundError as error:
    assert "not among the files" in str(error)
else:
    raise SystemExit("read from the disk")
"""


def test_a_process_reads_what_it_was_given_and_nothing_else(tmp_path: Path) -> None:
    import pickle

    path, link, other = tmp_path / "cell.yaml", tmp_path / "link.yaml", tmp_path / "other.yaml"
    path.write_text("as it was")
    link.symlink_to(path)
    with recorded() as files:
        assert read_text(link) == "as it was"
    path.write_text("edited")
    other.write_text("beside it")
    done = subprocess.run(
        [sys.executable, "-c", CODE, path, link, other], input=pickle.dumps(files), check=False,
        stderr=subprocess.PIPE,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()


def test_only_what_is_read_inside_is_recorded(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(b"\xef\xbb\xbfone\r\ntwo")
    read_bytes(tmp_path / "a")
    with recorded() as files:
        assert read_text(tmp_path / "b", "utf-8-sig") == "one\ntwo"
    assert list(files) == [str(tmp_path / "b")]


def test_a_missing_file_is_the_same_error_as_ever(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), recorded():
        read_text(tmp_path / "nothing")
