"""Roster: what it accepts, and that no change of it goes unseen."""

from __future__ import annotations

import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import TrustError
from dwell.live.trust.authority import Authority
from dwell.live.trust.roster import ROLES, Roster, Subject


@given(where=st.floats(0, 1, exclude_max=True), change=st.integers(1, 255))
def test_no_changed_roster_is_accepted(
    tmp_path_factory: pytest.TempPathFactory, where: float, change: int
) -> None:
    authority = Authority.create(tmp_path_factory.mktemp("keys") / "keys", "cell")
    authority.issue("R1", "node")
    path = authority.folder / "R1" / "roster.json"
    text = bytearray(path.read_bytes())
    text[int(where * len(text))] ^= change
    before = json.loads(path.read_bytes())
    path.write_bytes(bytes(text))
    key = authority._key.public_key()
    try:
        found = Roster.read(path, key)
    except TrustError:
        return
    # White space, and what JSON may write in two ways, may change; what it says may not.
    assert json.loads(path.read_bytes()) | {"signature": ""} == before | {"signature": ""}
    assert found.number == before["number"]


@given(
    name=st.text(max_size=60),
    role=st.sampled_from([*ROLES, "other"]),
    generation=st.integers(-1, 3),
    serial=st.integers(-1, 3),
)
def test_subjects_are_valid_or_refused(name: str, role: str, generation: int, serial: int) -> None:
    try:
        subject = Subject(name, role, generation, serial, "", "")  # type: ignore[arg-type]
    except TrustError:
        return
    assert os.sep not in subject.common_name
    assert subject.common_name.count(".") == 1
