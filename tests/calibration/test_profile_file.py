"""Profile files: what goes in comes out, and nothing is lost on the way."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.calibration.profile_file import (
    KEY,
    Measurement,
    merge_profiles,
    read_profile,
    require_free,
    write_profile,
)
from dwell.errors import ProfileError
from tests.calibration.samples import link, task


def same(one: Measurement, other: Measurement) -> bool:
    return (
        one.name == other.name
        and one.about == other.about
        and list(one.columns) == list(other.columns)
        and all(np.array_equal(one.columns[name], other.columns[name]) for name in one.columns)
    )


@given(
    st.lists(st.floats(0, 1e9), min_size=1, max_size=20), st.text(max_size=20), st.floats(0.1, 8)
)
def test_samples_come_back_as_they_were(
    tmp_path_factory: pytest.TempPathFactory, samples: list[float], note: str, cores: float
) -> None:
    path = tmp_path_factory.mktemp("profile") / "deep" / "p.parquet"
    written = [task("t", "n", samples, cores, callable=note), link("n", "m", samples, None)]
    write_profile(path, written)
    read = read_profile(path)
    assert all(same(one, other) for one, other in zip(written, read, strict=True))
    assert [item.name for item in path.parent.iterdir()] == ["p.parquet"]
    assert path.stat().st_mode & 0o777 == 0o644


def test_anyone_can_read_the_columns(tmp_path: Path) -> None:
    path = tmp_path / "p.parquet"
    write_profile(path, [task("t", "n", [1.5, 2.5])])
    frame = pl.read_parquet(path)
    assert frame["t@n"].to_list() == [1.5, 2.5]
    assert frame.columns == ["t@n", "t@n/cpu_ms"]


def test_merging_keeps_everything_in_the_order_given(tmp_path: Path) -> None:
    parts = [
        [task("a", "R1", [1, 2]), task("b", "R1", [3, 4])],
        [task("a", "E", [5, 6], note="x")],
        [link("R1", "E", [7, 8], 90.0)],
    ]
    paths = [tmp_path / f"{index}.parquet" for index in range(3)]
    for path, part in zip(paths, parts, strict=True):
        write_profile(path, part)
    merged = merge_profiles(paths)
    expected = [one for part in parts for one in part]
    assert all(same(one, other) for one, other in zip(merged, expected, strict=True))
    write_profile(tmp_path / "all.parquet", merged)
    assert len(read_profile(tmp_path / "all.parquet")) == 4


def test_the_same_twice_is_refused_by_both_files(tmp_path: Path) -> None:
    one, other = tmp_path / "one.parquet", tmp_path / "other.parquet"
    write_profile(one, [task("a", "R1", [1])])
    write_profile(other, [task("b", "R1", [1]), task("a", "R1", [2])])
    with pytest.raises(ProfileError, match=f"a@R1 is both in {one} and in {other}"):
        merge_profiles([one, other])
    with pytest.raises(ProfileError, match="is both in"):
        merge_profiles([one, one])


def test_files_of_different_lengths_are_not_merged(tmp_path: Path) -> None:
    one, other = tmp_path / "one.parquet", tmp_path / "other.parquet"
    write_profile(one, [task("a", "R1", [1, 2])])
    write_profile(other, [task("a", "E", [1, 2, 3])])
    with pytest.raises(ProfileError, match=f"{one} 2, {other} 3.* keep separate files"):
        merge_profiles([one, other])
    with pytest.raises(ProfileError, match="a@R1 2, a@E 3"):
        write_profile(tmp_path / "p.parquet", [task("a", "R1", [1, 2]), task("a", "E", [1, 2, 3])])
    assert not (tmp_path / "p.parquet").exists()


def test_a_name_once(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="a@R1: measured twice"):
        write_profile(tmp_path / "p.parquet", [task("a", "R1", [1]), task("a", "R1", [2])])


# ---------------------------------------------------------------------- what is there already


def test_measuring_again_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "p.parquet"
    write_profile(path, [task("a", "R1", [1])])
    write_profile(path, [task("a", "R1", [2, 3]), task("b", "R1", [4, 5])])
    assert [len(one.samples) for one in read_profile(path)] == [2, 2]


def test_samples_are_not_lost_by_measuring_something_else(tmp_path: Path) -> None:
    path = tmp_path / "p.parquet"
    write_profile(path, [task("a", "R1", [1]), task("b", "R1", [1])])
    with pytest.raises(ProfileError, match=r"p\.parquet holds a@R1, which would be lost"):
        write_profile(path, [task("b", "R1", [2])])
    assert read_profile(path)[1].samples[0] == 1


def test_files_of_others_are_left_alone(tmp_path: Path) -> None:
    trace = tmp_path / "trace.parquet"
    pl.DataFrame({"t@n": [1.0]}).write_parquet(trace)
    with pytest.raises(ProfileError, match="exists and is no profile"):
        require_free(trace, ["t@n"])
    (tmp_path / "folder.parquet").mkdir()
    with pytest.raises(ProfileError, match="is a folder"):
        require_free(tmp_path / "folder.parquet", [])
    with pytest.raises(ProfileError, match=r"let its name end in \.parquet"):
        require_free(tmp_path / "p.csv", [])


def test_an_interrupted_write_leaves_the_file_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.parquet"
    write_profile(path, [task("a", "R1", [1])])

    def crash(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", crash)
        with pytest.raises(KeyboardInterrupt):
            write_profile(path, [task("a", "R1", [2])])
    assert read_profile(path)[0].samples.tolist() == [1]
    assert [item.name for item in tmp_path.iterdir()] == ["p.parquet"]


# ------------------------------------------------------------------------------- damaged files


def test_files_that_are_no_profiles(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="no such file"):
        read_profile(tmp_path / "missing.parquet")
    text = tmp_path / "text.parquet"
    text.write_text("nothing of the kind")
    with pytest.raises(ProfileError, match=r"text\.parquet cannot be read"):
        read_profile(text)
    trace = tmp_path / "trace.parquet"
    pl.DataFrame({"t@n": [1.0]}).write_parquet(trace)
    with pytest.raises(ProfileError, match="is no profile"):
        read_profile(trace)


ENTRY = {"columns": ["t@n"], "kind": "task"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "cannot be understood"),
        ("[]", "cannot be understood"),
        ('{"format": 1, "measurements": [1]}', "cannot be understood"),
        ('{"format": 1, "measurements": {"t@n": {}}}', "cannot be understood"),
        ('{"format": 1, "measurements": {"t@n": {"columns": []}}}', "cannot be understood"),
        ('{"format": "one", "measurements": {}}', "cannot be understood"),
        ('{"format": 2, "measurements": {}}', "format 2; this version reads 1 only"),
        ('{"format": 0, "measurements": {}}', "format 0; this version reads 1 only"),
        (
            json.dumps({"format": 1, "measurements": {"x@n": {"columns": ["x@n"]}}}),
            "no numbers in a column 'x@n'",
        ),
        (
            json.dumps({"format": 1, "measurements": {"text": {"columns": ["text"]}}}),
            "no numbers in a column 'text'",
        ),
        (json.dumps({"format": 1, "measurements": {"t@n": ENTRY}}), "'t@n' has no value in row 2"),
    ],
)
def test_profiles_that_are_damaged(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "p.parquet"
    frame = pl.DataFrame({"t@n": [1.0, None], "text": ["a", "b"]})
    frame.write_parquet(path, metadata={KEY: text})
    with pytest.raises(ProfileError, match=words) as caught:
        read_profile(path)
    assert str(path) in str(caught.value)
