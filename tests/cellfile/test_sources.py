from __future__ import annotations

import re

import pytest

from dwell.cellfile.sources import digest_of


def test_a_digest_is_of_the_files_that_are_named() -> None:
    assert re.fullmatch("[0-9a-f]{16}", digest_of(["sim", "cost.py"]))
    assert digest_of(["cost.py"]) == digest_of(["cost.py"])
    assert len({digest_of([name]) for name in ("cost.py", "errors.py", "sim", "model")}) == 4
    assert digest_of(["model", "sim"]) != digest_of(["sim", "model"])


def test_a_digest_of_sources_that_are_not_there_is_an_error() -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        digest_of(["nowhere"])
