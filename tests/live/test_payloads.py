"""Payloads: what goes in comes out; what is anything else is refused, with few words."""

from __future__ import annotations

from contextlib import suppress

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from dwell.errors import LiveError
from dwell.live.payloads import read_payload, write_payload


class Spot(msgspec.Struct):
    row: float
    column: float


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
    with pytest.raises(LiveError, match="no Pose: Object missing required field `row`"):
        read_payload(kind, bytes(data), Spot)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        ("text", "a str cannot be sent; send bytes, an array, or a msgspec.Struct"),
        ({"a": 1}, "a dict cannot be sent"),
        (np.array([object()]), "an array of object cannot be sent; send numbers"),
        (np.array(["a"]), "an array of <U1 cannot be sent"),
        (np.zeros((1,) * 9), "an array of 9 dimensions; at most 8"),
    ],
)
def test_what_cannot_be_sent_is_named(payload: object, words: str) -> None:
    with pytest.raises(LiveError) as caught:
        write_payload(payload)
    assert words in str(caught.value)


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
