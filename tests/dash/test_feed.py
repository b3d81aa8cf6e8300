"""A reader who is behind loses what is gone, and knows how much."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dwell.dash.feed import Feed


@given(st.integers(1, 10), st.lists(st.integers(0, 12), max_size=20))
def test_what_was_read_and_what_was_dropped_is_all(most: int, bursts: list[int]) -> None:
    feed: Feed[int] = Feed(most)
    upto = read = dropped = published = 0
    for burst in bursts:
        for _ in range(burst):
            feed.append(published)
            published += 1
        news = feed.since(upto)
        assert news.items == list(range(news.upto - len(news.items), news.upto))
        upto, read, dropped = news.upto, read + len(news.items), dropped + news.dropped
    assert read + dropped == published == feed.upto
