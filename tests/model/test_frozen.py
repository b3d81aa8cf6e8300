from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest

from dwell.errors import ProblemError
from dwell.model import FrozenDict, Node
from dwell.model.frozen import require_names, shortened

KEPT = FrozenDict({"a": 1, "b": 2})


@pytest.mark.parametrize(
    "change",
    [
        lambda one: one.__setitem__("a", 2),
        lambda one: one.__delitem__("a"),
        lambda one: one.update(a=2),
        lambda one: one.pop("a"),
        lambda one: one.clear(),
        lambda one: one.setdefault("c", 3),
        lambda one: one.__ior__({"c": 3}),
        lambda one: one.popitem(),
    ],
)
def test_it_cannot_be_changed(change: Callable[[FrozenDict[str, int]], object]) -> None:
    with pytest.raises(TypeError, match="make a new one"):
        change(KEPT)
    assert KEPT == {"a": 1, "b": 2}


def test_it_hashes_pickles_and_copies() -> None:
    assert hash(KEPT) == hash(FrozenDict({"b": 2, "a": 1}))
    for other in (pickle.loads(pickle.dumps(KEPT)), copy.deepcopy(KEPT)):
        assert type(other) is FrozenDict
        assert other == KEPT


def test_items_go_by_their_names() -> None:
    require_names("nodes", {"R1": Node("R1", "robot", 4)})
    with pytest.raises(ProblemError, match=r"nodes\.R2.*named as its key, 'R2'"):
        require_names("nodes", {"R2": Node("R1", "robot", 4)})


def test_of_many_names_the_first_are_shown() -> None:
    assert shortened([]) == "none"
    assert shortened(list("abcdef")) == "a, b, c, d, e, f"
    assert shortened(list("abcdefgh"), " > ") == "a > b > c > d > e > f > 2 more"
