"""Keys, and the expressions that they are matched with."""

from __future__ import annotations

import pytest

from dwell.errors import LiveError
from dwell.live.transport.expressions import require_expression, require_key


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
