from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.kernels.realisation import LinkSegments, NodeChanges
from dwell.sim import LinkSegment, NodeChange

CHANGES = st.lists(
    st.builds(
        NodeChange,
        at_ns=st.integers(0, 10**12),
        node=st.sampled_from(["R1", "E"]),
        threads=st.integers(0, 9),
        down=st.booleans(),
    ),
    max_size=8,
)
SEGMENTS = st.lists(
    st.builds(
        LinkSegment,
        at_ns=st.integers(0, 10**12),
        link=st.sampled_from(["R1->E", "E->R1"]),
        down=st.booleans(),
        loss=st.sampled_from([0.0, 0.25]),
        rate_mbps=st.sampled_from([100.0, float("inf")]),
        layers=st.sets(st.integers(0, 40)).map(lambda found: tuple(sorted(found))),
    ),
    max_size=8,
)


@given(CHANGES)
def test_node_changes_read_as_they_were_given(changes: list[NodeChange]) -> None:
    kept = NodeChanges.of(changes)
    assert list(kept) == changes
    assert len(kept) == len(changes)
    assert list(kept[1:3]) == changes[1:3]
    assert NodeChanges.of(kept) is kept
    assert kept.table.dtype == np.int64


@given(SEGMENTS)
def test_link_segments_read_as_they_were_given(segments: list[LinkSegment]) -> None:
    kept = LinkSegments.of(segments)
    assert list(kept) == segments
    assert list(kept[::2]) == segments[::2]
    assert LinkSegments.of(kept) is kept
