"""Links of messages that processes share: what a message meets there, as the simulator has it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.local.conditions import transmission_ns
from dwell.live.local.message_links import HELD, LOST, LinkEnds, LinkFile
from dwell.model import Constant, Execution, Flow, Link, Node, Normal, Task
from tests.cells.generated import make_problem

NODES = "R1", "E", "R2"
MS = 1_000_000
#: A message of 25 kB takes 10 ms.
RATE_MBPS, BYTES = 20.0, 25_000


@pytest.fixture
def file(tmp_path: Path) -> Iterator[LinkFile]:
    with closing(LinkFile(tmp_path / "links", NODES, seed=3)) as opened:
        yield opened


def ends(file: LinkFile, who: str = "camera@R1") -> LinkEnds:
    return LinkEnds(file.path, who, who.partition("@")[2])


def test_a_link_without_conditions_takes_no_time(file: LinkFile) -> None:
    assert ends(file).to["E"].begin(BYTES, 7) == 7


def test_two_processes_have_one_backlog(file: LinkFile) -> None:
    file.set("R1", "E", rate_mbps=RATE_MBPS, delay_ms=Constant(3.0))
    one, other = ends(file).to["E"], ends(file, "stamper@R1").to["E"]
    now_ns = 10**12
    found = [way.begin(BYTES, now_ns) for way in (one, other, one, other)]
    assert found == [now_ns + (10 * n + 3) * MS for n in (1, 2, 3, 4)]
    # The way back is another one, and so is the one to another node.
    assert ends(file, "perception@E").to["R1"].begin(BYTES, now_ns) == now_ns
    assert one.begin(0, now_ns + 100 * MS) == now_ns + 103 * MS


def send_all(path: Path, who: str, count: int, begun: object, found: object) -> None:
    """Send messages as fast as they come, and tell when each of them arrives."""
    way = LinkEnds(path, who, "R1").to["E"]
    begun.wait()  # type: ignore[attr-defined]
    for _ in range(count):
        now_ns = time.monotonic_ns()
        found.put((now_ns, way.begin(BYTES, now_ns)))  # type: ignore[attr-defined]


def test_two_real_processes_have_one_backlog(file: LinkFile) -> None:
    """What two processes send at the same time is on the link one after another."""
    file.set("R1", "E", rate_mbps=RATE_MBPS)
    context = multiprocessing.get_context("spawn")
    begun, queue = context.Event(), context.Queue()
    senders = [
        context.Process(target=send_all, args=(file.path, who, 40, begun, queue))
        for who in ("camera@R1", "stamper@R1")
    ]
    for sender in senders:
        sender.start()
    begun.set()
    passed = [queue.get(timeout=60) for _ in range(80)]
    for sender in senders:
        sender.join()
    # They leave one after another, 10 ms each, whoever sent them: nothing is on it twice.
    arrivals = np.array(sorted(arrival for _, arrival in passed))
    apart = np.diff(arrivals)
    assert (apart >= transmission_ns(BYTES, RATE_MBPS)).all()
    # All but those that came to an idle link, at the beginning.
    assert (apart == transmission_ns(BYTES, RATE_MBPS)).sum() >= 70


def test_two_processes_on_a_link_of_20_mbits_meet_what_the_simulator_has(file: LinkFile) -> None:
    """Two sources of 25 kB each, every 15 ms, on a link that takes 20 ms for both: it fills up."""
    on_r1, on_e = ({node: Execution(Constant(1.0))} for node in ("R1", "E"))
    problem = make_problem(
        [Node("R1", "robot", cores=2), Node("E", "edge", cores=2)],
        [Task("camera", on_r1), Task("lidar", on_r1), Task("fusion", on_e)],
        [Flow("camera", "fusion", BYTES), Flow("lidar", "fusion", BYTES)],
        links=[Link("R1", "E", Constant(3.0), rate_mbps=RATE_MBPS)],
        period_ms=15.0,
        window_cycles=20,
    )
    run = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=6)
    file.set("R1", "E", rate_mbps=RATE_MBPS, delay_ms=Constant(3.0))
    one, other = ends(file).to["E"], ends(file, "lidar@R1").to["E"]
    compared = 0
    for release_ns, latency_ns in run.cycles.select("release_ns", "latency_ns").head(40).rows():
        sent_ns = release_ns + MS
        arrivals = [way.begin(BYTES, sent_ns) for way in (one, other)]
        assert max(arrivals) == release_ns + latency_ns - MS
        compared += 1
    # By then the last one has waited for its turn for 5 ms in each cycle.
    assert compared == 40
    assert latency_ns > 200 * MS


def test_delays_are_drawn_and_each_process_has_its_own(file: LinkFile) -> None:
    file.set("R1", "E", delay_ms=Normal(25.0, 5.0))
    one, other, again = ends(file), ends(file, "stamper@R1"), ends(file)
    drawn = [[way.to["E"].begin(0, 0) for _ in range(2_000)] for way in (one, other)]
    assert drawn[0] != drawn[1]
    assert drawn[0][:50] == [again.to["E"].begin(0, 0) for _ in range(50)]
    for mine in drawn:
        # 5 ms over the root of 2000: 0.11 ms.
        assert np.mean(mine) / MS == pytest.approx(25.0, abs=6 * 0.11)
        assert np.std(mine) / MS == pytest.approx(5.0, rel=0.1)


def test_a_delay_that_stays_goes_on_while_others_change(file: LinkFile) -> None:
    file.set("R1", "E", delay_ms=Normal(25.0, 5.0))
    first = ends(file).to["E"]
    undisturbed = [first.begin(0, 0) for _ in range(20)]
    way = ends(file).to["E"]
    found = [way.begin(0, 0) for _ in range(10)]
    file.set("R1", "E", rate_mbps=1e3)
    found += [way.begin(0, 0) for _ in range(10)]
    assert found == undisturbed


def test_losses_and_cuts(file: LinkFile) -> None:
    way = ends(file).to["E"]
    file.set("R1", "E", loss=0.02)
    lost = sum(way.begin(10, 0) < 0 for _ in range(20_000))
    # 400 expected, 19.8 of standard deviation.
    assert abs(lost - 400) < 6 * 19.8
    file.set("R1", "E", loss=0.0, down=True)
    assert way.begin(10, 0) == LOST
    file.set("R1", "E", down=False)
    assert way.begin(10, 5) == 5


def test_of_a_loss_of_1_all_is_lost_or_waits_where_it_would_be_sent_again(tmp_path: Path) -> None:
    links = [Link("R1", "E", Constant(0.0)), Link("E", "R1", Constant(0.0), retransmit_ms=40.0)]
    with closing(LinkFile(tmp_path / "links", NODES, links, seed=1)) as file:
        there, back = ends(file).to["E"], ends(file, "perception@E").to["R1"]
        file.set("R1", "E", loss=1.0)
        file.set("E", "R1", loss=1.0)
        assert {there.begin(10, n) for n in range(100)} == {LOST}
        assert {back.begin(10, n) for n in range(100)} == {HELD}
        file.set("E", "R1", loss=0.0)
        assert back.begin(10, 7) == 7


def test_a_link_that_retransmits_loses_nothing_and_keeps_order_where_it_is_to(
    tmp_path: Path,
) -> None:
    links = [
        Link("R1", "E", Constant(0.0), retransmit_ms=40.0),
        Link("E", "R1", Constant(0.0), in_order=True),
    ]
    with closing(LinkFile(tmp_path / "links", NODES, links, seed=1)) as file:
        file.set("R1", "E", loss=0.5)
        way = ends(file).to["E"]
        found = np.array([way.begin(0, 0) for _ in range(2_000)])
        assert (found >= 0).all()
        assert set(found // (40 * MS)) > {0, 1, 2}
        assert np.mean(found == 0) == pytest.approx(0.5, abs=6 * 0.5 / 2_000**0.5)
        file.set("R1", "E", down=True)
        assert way.begin(0, 0) == HELD
        file.set("E", "R1", delay_ms=Normal(25.0, 5.0))
        back = ends(file, "perception@E").to["R1"]
        arrivals = [back.begin(0, n * MS) for n in range(200)]
        assert arrivals == sorted(arrivals)


def test_messages_wait_for_one_that_is_sent_again_where_order_is_kept(tmp_path: Path) -> None:
    arrivals = []
    for in_order in (True, False):
        link = Link("R1", "E", Constant(5.0), retransmit_ms=200.0, in_order=in_order)
        with closing(LinkFile(tmp_path / f"links-{in_order}", NODES, [link], seed=1)) as file:
            file.set("R1", "E", delay_ms=Constant(5.0), loss=0.05)
            # Two processes send in turn.
            ways = [ends(file, who).to["E"] for who in ("camera@R1", "stamper@R1")]
            arrivals.append([ways[n % 2].begin(0, n * 10 * MS) for n in range(2_000)])
    kept, free = map(np.array, arrivals)
    assert (np.diff(free) < 0).any()
    assert (kept == np.maximum.accumulate(free)).all()


def test_what_would_wait_too_long_is_lost_and_takes_no_time(file: LinkFile) -> None:
    file.set("R1", "E", rate_mbps=0.1)
    way = ends(file).to["E"]
    # Of 2 s each, five leave within the ten seconds.
    found = [way.begin(BYTES, 0) for _ in range(7)]
    assert found == [2_000 * MS * n for n in (1, 2, 3, 4, 5)] + [-1, -1]


def test_who_says_what_is_wrong_is_told(file: LinkFile, tmp_path: Path) -> None:
    with pytest.raises(LiveError, match="no link R1->X"):
        file.set("R1", "X", loss=0.1)
    with pytest.raises(LiveError, match=r"link R1->E: loss: 1.5 is not allowed"):
        file.set("R1", "E", loss=1.5)
    with pytest.raises(LiveError, match="cannot be written"):
        LinkFile(tmp_path / "missing" / "links", NODES)
    with pytest.raises(LiveError, match=r"missing: cannot be read"):
        LinkEnds(tmp_path / "missing", "camera@R1", "R1")
    with pytest.raises(LiveError, match="no node X; it has R1, E, R2"):
        LinkEnds(file.path, "camera@X", "X")
    content = file.path.read_bytes()
    for spoilt in (b"", b"x" + content[1:], content[:-1], content + b"]", content[:24]):
        other = tmp_path / "spoilt"
        other.write_bytes(spoilt)
        with pytest.raises(LiveError, match="is no file of links"):
            LinkEnds(other, "camera@R1", "R1")
