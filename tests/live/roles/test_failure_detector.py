from __future__ import annotations

from dwell.live.roles.failure_detector import FailureDetector
from dwell.live.wire.messages import Beat

MS = 1_000_000


def beat(sent_ms: int, *, life: int = 1, who: str = "plan@E") -> Beat:
    return Beat(who, "E", life, sent_ms * MS, True)


def test_who_beats_is_fresh_for_as_long_as_the_patience() -> None:
    detector = FailureDetector("arm@R2", 100 * MS)
    assert not detector.fresh("plan@E", 0)
    assert detector.age_ns("plan@E", 0) is None
    assert detector.hear(beat(0), 10 * MS)
    assert detector.fresh("plan@E", 110 * MS)
    assert not detector.fresh("plan@E", 110 * MS + 1)
    assert detector.fresh("plan@E", 150 * MS, 200 * MS)


def test_a_second_copy_and_ones_own_beat_are_no_news() -> None:
    detector = FailureDetector("arm@R2", 100 * MS)
    assert not detector.hear(beat(0, who="arm@R2"), 0)
    assert detector.hear(beat(5), 10 * MS)
    assert not detector.hear(beat(5), 12 * MS)
    assert not detector.hear(beat(4), 13 * MS, direct=False)
    assert detector.age_ns("plan@E", 20 * MS) == 10 * MS


def test_what_came_over_the_detour_is_not_said_to_be_heard_directly() -> None:
    detector = FailureDetector("arm@R2", 100 * MS)
    detector.hear(beat(5), 10 * MS, direct=False)
    assert detector.heard(11 * MS) == ()
    assert detector.hear(beat(5), 11 * MS), "its direct copy is news of the direct way"
    ((who, node, sent_ns, at_ns),) = [
        (one.who, one.node, one.beat_ns, one.at_ns) for one in detector.heard(12 * MS)
    ]
    assert (who, node, sent_ns, at_ns) == ("plan@E", "E", 5 * MS, 11 * MS)
    # It stays out of later beats: nothing is known of the link then.
    assert detector.heard(212 * MS) == ()


def test_who_starts_anew_is_heard_at_once() -> None:
    detector = FailureDetector("arm@R2", 100 * MS)
    detector.hear(beat(900, life=1), 10 * MS)
    assert detector.hear(beat(0, life=2), 20 * MS)
    last = detector.last("plan@E")
    assert last is not None
    assert last.life == 2


def test_whose_clock_is_set_back_is_heard_again_over_the_detour_alone() -> None:
    detector = FailureDetector("controller@E", 100 * MS)
    detector.hear(beat(9_000), 10 * MS, direct=False)
    heard = [detector.hear(beat(10 + i), (20 + i) * MS, direct=False) for i in range(6)]
    assert heard == [False] * 4 + [True] * 2


def test_what_was_heard_before_ones_own_clock_was_set_back_ages_since() -> None:
    detector = FailureDetector("arm@R2", 100 * MS)
    detector.hear(beat(0), 5_000 * MS)
    assert detector.age_ns("plan@E", 10 * MS) == 0
    assert detector.age_ns("plan@E", 30 * MS) == 20 * MS
