"""Keys, and the expressions that they are matched with, as Zenoh matches them."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import LiveError
from dwell.live.transport.expressions import matcher, require_expression, require_key

CHUNKS = st.sampled_from(["dwell", "in", "E", "a.b", "x-1", "état"])
KEYS = st.lists(CHUNKS, min_size=1, max_size=5).map("/".join)
EXPRESSIONS = st.lists(CHUNKS | st.sampled_from(["*", "**"]), min_size=1, max_size=5).map("/".join)


@given(KEYS, EXPRESSIONS)
def test_a_key_is_under_an_expression_where_zenoh_says_so(key: str, expression: str) -> None:
    try:
        matches = matcher(expression)
    except LiveError:
        # There is one way to write each, which Zenoh takes and the other it does not.
        assert "**/*" in expression
        return
    require_key(key)
    assert matches(key) == zenoh.KeyExpr(expression).includes(zenoh.KeyExpr(key))


@pytest.mark.parametrize("key", ["", "a//b", "/a", "a/", "a/@b", "a/b c", "a/*", "a/$b", "a?", "#"])
def test_a_key_that_nothing_can_be_sent_under(key: str) -> None:
    with pytest.raises(LiveError, match="is empty, starts with @, or has white space"):
        require_key(key)


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        ("a/**/*", r"write \*/\*\* and not \*\*/\*"),
        ("a/**/**", r"write \*/\*\* and not \*\*/\*\*"),
        ("a/b*", "neither a plain name nor"),
        ("a//b", "neither a plain name nor"),
    ],
)
def test_an_expression_that_cannot_be_subscribed_to(expression: str, words: str) -> None:
    with pytest.raises(LiveError, match=words):
        require_expression(expression)
