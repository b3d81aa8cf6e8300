"""Keys: fields that say their bound, default and sentence, and classes that check them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, FrozenInstanceError
from typing import Literal

import pytest

import dwell.model
from dwell.errors import ProblemError
from dwell.model.bounds import Bound
from dwell.model.declaration import declared, declared_fields, is_declared, key, within_path
from dwell.model.frozen import FrozenDict


@declared("part")
class Sample:
    """A sample."""

    name: str
    count: int = key("How many.", Bound(1, 9, whole=True), named="number")
    kind: Literal["one", "other"] = key("Which.", default="one")
    shares: Mapping[str, float] = key("By name.", Bound(0, 1), default_factory=dict)
    order: tuple[str, ...] = key("In turn.", default=())
    least: float | None = key("At least.", Bound(0, 5), default=None, usual="all")
    on: bool = key("Whether.", default=False)

    def __post_init__(self) -> None:
        if self.name == "bad":
            raise ProblemError("bad")


def test_what_is_given_is_kept_and_frozen() -> None:
    made = Sample("a", 2, shares={"x": 0.5}, order=["b"])  # type: ignore[arg-type]
    assert (made.count, made.kind, made.order, made.least) == (2, "one", ("b",), None)
    assert isinstance(made.shares, FrozenDict)
    with pytest.raises(FrozenInstanceError):
        made.count = 3  # type: ignore[misc]
    assert not hasattr(made, "__dict__")


@pytest.mark.parametrize(
    ("given", "path", "told"),
    [
        ({"count": 0}, "part.number", "a whole number from 1 to 9"),
        ({"kind": "third"}, "part.kind", "one of one, other"),
        ({"shares": {"x": 2.0}}, "part.shares.x", "a number from 0 to 1"),
        ({"least": 6.0}, "part.least", "a number from 0 to 5"),
        ({"on": 1}, "part.on", "true or false"),
    ],
)
def test_a_value_out_of_its_bound_is_refused(
    given: dict[str, object], path: str, told: str
) -> None:
    with pytest.raises(ProblemError) as caught:
        Sample(**{"name": "a", "count": 1, **given})  # type: ignore[arg-type]
    (fault,) = caught.value.faults
    assert fault.path == path
    assert told in fault.message


def test_a_class_checks_values_against_each_other_after_that() -> None:
    with pytest.raises(ProblemError, match="bad"):
        Sample("bad", 1)
    with pytest.raises(ProblemError, match="number"):
        Sample("bad", 0)


def test_fields_say_what_they_declare() -> None:
    fields = {one.named: one for one in declared_fields(Sample)}
    assert list(fields) == ["number", "kind", "shares", "order", "least", "on"]
    assert fields["number"].default is MISSING
    assert fields["kind"].choices == ("one", "other")
    assert fields["shares"].is_mapping
    assert fields["least"].kind is float
    assert fields["least"].key.usual == "all"
    assert "How many." in (Sample.__doc__ or "")


def test_faults_of_a_class_that_names_its_section_are_beneath_what_is_around() -> None:
    assert is_declared(Sample)
    assert not is_declared(int)
    assert within_path("a.part", Sample, "part.number") == "a.part.number"
    assert within_path("a", int, "b") == "a.b"
    assert within_path("", int, "b") == "b"


@pytest.mark.parametrize(
    "kind",
    [one for one in vars(dwell.model).values() if isinstance(one, type) and is_declared(one)],
)
def test_every_key_of_the_model_says_one_sentence(kind: type) -> None:
    for one in declared_fields(kind):
        assert one.key.says.endswith("."), one.named
        assert one.key.says[0].isupper() or one.key.says[0] == "`", one.named
