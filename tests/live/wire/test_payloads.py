"""Payloads: what goes in comes out; what is anything else is refused, with few words."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from dwell.errors import LiveError
from dwell.live.wire.payloads import read_payload, write_payload


class Spot(msgspec.Struct):
    row: float
    column: float


class Track(msgspec.Struct):
    """A struct with everything that a struct can hold."""

    label: object
    scores: list[object]
    spots: dict[str, object]
    origin: Spot


NUMBERS = st.one_of(
    arrays.integer_dtypes(),
    arrays.unsigned_integer_dtypes(),
    arrays.floating_dtypes(),
    arrays.complex_number_dtypes(),
    arrays.boolean_dtypes(),
)


@given(
    arrays.arrays(
        NUMBERS,
        arrays.array_shapes(min_dims=0, max_dims=8, min_side=0, max_side=3),
        fill=st.just(0),
    )
)
def test_arrays_arrive_as_they_were(array: np.ndarray) -> None:
    kind, data = write_payload(array)
    found = read_payload(kind, bytes(data))
    assert isinstance(found, np.ndarray)
    assert (found.dtype, found.shape) == (array.dtype, array.shape)
    assert found.tobytes() == array.tobytes()
    assert not found.flags.writeable


def test_an_array_that_is_not_contiguous_arrives_whole() -> None:
    array = np.arange(24).reshape(4, 6)[::2, ::-3]
    kind, data = write_payload(array)
    np.testing.assert_array_equal(read_payload(kind, bytes(data)), array)


def test_an_array_goes_out_without_a_copy() -> None:
    array = np.arange(10, dtype=np.uint8)
    _, data = write_payload(array)
    array[0] = 77
    assert bytes(data)[0] == 77


@pytest.mark.parametrize("payload", [b"", b"abc", bytearray(b"abc"), memoryview(b"abcd")[1:]])
def test_bytes_arrive_as_they_were(payload: bytes | bytearray | memoryview) -> None:
    kind, data = write_payload(payload)
    assert read_payload(kind, bytes(data)) == bytes(payload)


def test_nothing_arrives_as_nothing() -> None:
    assert read_payload(*write_payload(None)) is None  # type: ignore[arg-type]


def test_a_struct_arrives_as_what_the_stage_declares() -> None:
    kind, data = write_payload(Spot(1.5, 2.0))
    assert read_payload(kind, bytes(data), Spot) == Spot(1.5, 2.0)
    assert read_payload(kind, bytes(data)) == {"row": 1.5, "column": 2.0}


def test_a_struct_that_is_another_one_is_refused_by_name() -> None:
    class Pose(msgspec.Struct):
        x: float

    kind, data = write_payload(Pose(1.0))
    with pytest.raises(LiveError, match=r"a Pose where Spot is wanted .* missing .* `row`"):
        read_payload(kind, bytes(data), Spot)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        ("text", "a str cannot be sent; send bytes, an array, or a msgspec.Struct"),
        ({"a": 1}, "a dict cannot be sent"),
        (np.array([object()]), "an array of object cannot be sent; send numbers"),
        (np.array(["a"]), "an array of <U1 cannot be sent"),
        (np.zeros((1,) * 9), "an array of 9 dimensions; at most 8"),
        (np.ma.array([1.0], mask=[True]), "a masked array cannot be sent"),
    ],
)
def test_what_cannot_be_sent_is_named(payload: object, words: str) -> None:
    with pytest.raises(LiveError) as caught:
        write_payload(payload)
    assert words in str(caught.value)


SCALARS = st.one_of(
    st.booleans().map(np.bool_),
    *(
        st.integers(np.iinfo(kind).min, np.iinfo(kind).max).map(kind)
        for kind in (np.int8, np.uint8, np.int32, np.uint32, np.int64, np.uint64)
    ),
    st.floats(width=16, allow_nan=False).map(np.float16),
    st.floats(width=32, allow_nan=False).map(np.float32),
    st.floats(allow_nan=False).map(np.float64),
    st.floats(allow_nan=False).map(np.longdouble),
)


@given(SCALARS, st.lists(SCALARS, max_size=3))
def test_scalars_of_numpy_in_a_struct_arrive_as_numbers(
    number: np.generic, others: list[np.generic]
) -> None:
    spot = Spot(number, number)  # type: ignore[arg-type]
    kind, data = write_payload(Track(number, [*others, [number]], {"a": spot}, spot))
    found = read_payload(kind, bytes(data))
    assert isinstance(found, dict)
    assert found["label"] == number
    assert type(found["label"]) in (bool, int, float)
    assert found["scores"] == [*others, [number]]
    assert found["spots"]["a"] == found["origin"] == {"row": number, "column": number}


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (np.zeros(3), "ndarray"),
        (2**64, "int"),
        (-(2**63) - 1, "int"),
        (np.datetime64("2026-01-01"), "datetime64"),
        (np.timedelta64(1, "s"), "timedelta64"),
        (np.complex128(1j), "complex128"),
        ("\ud800", "str"),
        (object(), "object"),
    ],
)
def test_what_a_struct_cannot_hold_is_named_with_its_field(value: object, kind: str) -> None:
    spot = Spot(1.0, 2.0)
    for track, field in (
        (Track(value, [], {}, spot), "Track.label"),
        (Track("", [1, [value]], {}, spot), "Track.scores[1][0]"),
        (Track("", [], {"a": Spot(value, 1.0)}, spot), "Track.spots['a'].row"),  # type: ignore[arg-type]
        (Track("", [], {}, Spot(0.0, value)), "Track.origin.column"),  # type: ignore[arg-type]
    ):
        with pytest.raises(LiveError) as caught:
            write_payload(track)
        assert str(caught.value).startswith(f"{field}: a {kind} cannot be sent in a struct")


def test_a_struct_that_holds_itself_is_refused() -> None:
    scores: list[object] = []
    scores.append(scores)
    with pytest.raises(LiveError, match=r"Track\.scores"):
        write_payload(Track("", scores, {}, Spot(0.0, 0.0)))


@pytest.mark.parametrize(
    "view", [np.arange(6, dtype=np.uint8)[::2], np.arange(3, dtype=">i4"), np.zeros((0, 3))]
)
def test_any_view_arrives_as_its_bytes(view: np.ndarray) -> None:
    kind, data = write_payload(memoryview(view))  # type: ignore[arg-type]
    assert read_payload(kind, bytes(data)) == view.tobytes()


@pytest.mark.parametrize(
    "kind",
    [
        "array:|O:1",
        "array:<f8:-1",
        "array:<f8:1x1x1x1x1x1x1x1x8",
        "array:<f8:99999999999999999999",
        "array:<f8:two",
        "array:V8:1",
        "array:<f8,<f8:1",
        "array:" + "(" * 100 + ":1",
        "array",
        "pickle:x",
        "",
    ],
)
def test_a_kind_that_lies_is_refused(kind: str) -> None:
    with pytest.raises(LiveError):
        read_payload(kind, bytes(8))


KINDS = ("none", "bytes", "array:<f8:3", "array:|u1:2x2", "struct:Spot", "array:", "struct")


@given(
    st.one_of(
        st.sampled_from(KINDS), st.text(max_size=40), st.text(max_size=40).map("array:".__add__)
    ),
    st.binary(max_size=200),
    st.sampled_from([None, Spot]),
)
def test_any_bytes_are_read_or_refused(kind: str, data: bytes, expected: type | None) -> None:
    with suppress(LiveError):
        read_payload(kind, data, expected)


def test_a_first_payload_loads_no_further_part_of_numpy() -> None:
    """What takes a tenth of a second costs the first cycles of a cell."""
    program = (
        "import sys, msgspec, numpy\n"
        "from dwell.live.wire.payloads import write_payload\n"
        "class Spot(msgspec.Struct):\n    row: object\n"
        "for payload in (b'', numpy.zeros(3), Spot(numpy.int64(3))):\n    write_payload(payload)\n"
        "sys.exit('numpy.ma' in sys.modules)\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
