"""What every transport has to do, on each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from dwell.errors import LiveError
from dwell.live.wire.transport import Arrival, Lane, require_expression, require_key
from tests.live.transport.meshes import MemoryMesh, Mesh, ZenohMesh, introduce

A, B, FAR = "a@R1", "b@R1", "c@E"
LANES: tuple[Lane, ...] = ("control", "images")
# To a process of the same node and of another one; images take different sessions there.
KEYS = {B: "dwell/t/in/task/R1/main", FAR: "dwell/t/in/task/E/main"}


@pytest.fixture(params=["memory", "zenoh"])
def mesh(request: pytest.FixtureRequest) -> Iterator[Mesh]:
    made: Mesh = MemoryMesh() if request.param == "memory" else ZenohMesh([A, B, FAR])
    yield made
    made.close()


@pytest.mark.parametrize("target", [B, FAR])
def test_payloads_and_headers_arrive_as_they_were_sent(mesh: Mesh, target: str) -> None:
    inbox, sender, key = mesh.inbox(), mesh.open(A), KEYS[target]
    mesh.open(target).subscribe(key, inbox)
    sizes = (0, 1, 16_000, 100_000, 1_000_000)
    for lane in LANES:
        introduce(mesh, sender, key, [inbox], lane=lane)
        for size in sizes:
            payload = bytes(i * 7 % 251 for i in range(size % 1_000)) * max(1, size // 1_000)
            payload = payload.ljust(size, b"x")[:size]
            for header in (b"", b"\x00h", b"h" * 16_384):
                sender.put(key, payload, header, lane=lane)
                mesh.until(lambda: bool(inbox.samples))
                assert inbox.samples == [Arrival(key, payload, header)]
                inbox.samples.clear()


def test_names_with_spaces_and_letters_of_any_script_are_chunks(mesh: Mesh) -> None:
    sender, inbox, key = mesh.open(A), mesh.inbox(), "dwell/S\u00fcd x/in/find it/R1/main"
    mesh.open(B).subscribe("dwell/S\u00fcd x/in/find it/*/main", inbox)
    introduce(mesh, sender, key, [inbox])
    sender.put(key, b"seen", b"h")
    mesh.until(lambda: bool(inbox.samples))
    assert inbox.samples == [Arrival(key, b"seen", b"h")]


@pytest.mark.parametrize("lane", LANES)
def test_messages_of_one_sender_and_lane_arrive_once_and_in_order(mesh: Mesh, lane: Lane) -> None:
    inboxes = {B: mesh.inbox(), FAR: mesh.inbox()}
    sender = mesh.open(A)
    for who, inbox in inboxes.items():
        mesh.open(who).subscribe(KEYS[who], inbox)
        introduce(mesh, sender, KEYS[who], [inbox], lane=lane)

    def caught_up(count: int) -> Callable[[], bool]:
        return lambda: all(len(inbox.samples) >= count for inbox in inboxes.values())

    numbers = [b"%d" % i for i in range(200)]
    for i, number in enumerate(numbers):
        for key in KEYS.values():
            sender.put(key, number.ljust(i * 97 % 5_000), lane=lane)
        if i % 8 == 7:  # no more than a queue holds: they keep up, so nothing may be lost
            mesh.until(caught_up(i + 1))
    for inbox in inboxes.values():
        assert [payload.rstrip() for payload in inbox.payloads] == numbers


@pytest.mark.parametrize(
    ("expression", "heard"),
    [
        ("dwell/t/beat/*/*", ["dwell/t/beat/E/x", "dwell/t/beat/R1/x.y@E"]),
        ("dwell/t/beat/E/*", ["dwell/t/beat/E/x"]),
        ("dwell/*/order", ["dwell/t/order"]),
        ("dwell/t/order/**", ["dwell/t/order"]),
        ("dwell/t/*", ["dwell/t/order", "dwell/t/last"]),
        (
            "**",
            [
                "dwell/t/beat/E/x",
                "dwell/t/beat/R1/x.y@E",
                "dwell/t/order",
                "dwell/other/beat/E/x",
                "dwell/t/last",
            ],
        ),
        ("dwell/**/x", ["dwell/t/beat/E/x", "dwell/other/beat/E/x"]),
    ],
)
def test_wildcards_match_one_chunk_or_many(mesh: Mesh, expression: str, heard: list[str]) -> None:
    sender, receiver = mesh.open(A), mesh.open(FAR)
    inbox, end = mesh.inbox(), mesh.inbox()
    receiver.subscribe(expression, inbox)
    receiver.subscribe("dwell/t/last", end)
    introduce(mesh, sender, "dwell/t/last", [end])
    inbox.samples.clear()
    for key in (
        "dwell/t/beat/E/x",
        "dwell/t/beat/R1/x.y@E",
        "dwell/t/order",
        "dwell/other/beat/E/x",
        "dwell/t/last",
    ):
        sender.put(key, b"")
    mesh.until(lambda: bool(end.samples))
    mesh.until(lambda: len(inbox.samples) >= len(heard))
    assert inbox.keys == heard


def test_a_view_is_sent_as_the_bytes_it_shows(mesh: Mesh) -> None:
    sender, inbox = mesh.open(A), mesh.inbox()
    mesh.open(B).subscribe(KEYS[B], inbox)
    introduce(mesh, sender, KEYS[B], [inbox], lane="images")
    array = bytearray(range(256)) * 1_000
    sender.put(KEYS[B], memoryview(array)[1::2], lane="images")
    array[:] = bytes(len(array))  # it belongs to the sender again
    mesh.until(lambda: bool(inbox.samples))
    assert inbox.payloads == [bytes(range(1, 256, 2)) * 1_000]


def test_every_subscription_that_matches_is_handed_the_message(mesh: Mesh) -> None:
    sender, receiver = mesh.open(A), mesh.open(FAR)
    inboxes = [mesh.inbox(), mesh.inbox()]
    receiver.subscribe("dwell/t/done/*", inboxes[0])
    receiver.subscribe("dwell/t/done/arm", inboxes[1])
    introduce(mesh, sender, "dwell/t/done/arm", inboxes)
    sender.put("dwell/t/done/arm", b"once")
    mesh.until(lambda: all(inbox.samples for inbox in inboxes))
    assert [inbox.payloads for inbox in inboxes] == [[b"once"], [b"once"]]


def test_nobody_hears_itself(mesh: Mesh) -> None:
    sender, receiver = mesh.open(A), mesh.open(FAR)
    own, inbox = mesh.inbox(), mesh.inbox()
    sender.subscribe("dwell/**", own)
    receiver.subscribe("dwell/**", inbox)
    introduce(mesh, sender, "dwell/t/order", [inbox])
    assert own.samples == []


def test_a_late_joiner_hears_only_what_is_put_from_then_on(mesh: Mesh) -> None:
    sender, first = mesh.open(A), mesh.inbox()
    mesh.open(B).subscribe("dwell/t/order", first)
    introduce(mesh, sender, "dwell/t/order", [first])
    sender.put("dwell/t/order", b"early")
    mesh.until(lambda: first.payloads == [b"early"])
    late = mesh.inbox()
    mesh.open(FAR).subscribe("dwell/t/order", late)
    introduce(mesh, sender, "dwell/t/order", [late, first])
    sender.put("dwell/t/order", b"now")
    mesh.until(lambda: bool(late.samples and first.samples))
    assert late.payloads == [b"now"]


def test_it_does_not_matter_who_starts_first(mesh: Mesh) -> None:
    # The last of the names connects, and finds nobody at first.
    inbox = mesh.inbox()
    late = mesh.open(FAR)
    late.put("dwell/t/order", b"to nobody")
    late.subscribe("dwell/t/beat/**", inbox)
    sender = mesh.open(A)
    introduce(mesh, sender, "dwell/t/beat/R1/a", [inbox])


def test_a_receiver_may_answer(mesh: Mesh) -> None:
    one, other = mesh.open(A), mesh.open(FAR)
    answers = mesh.inbox()
    one.subscribe("dwell/t/answer/*", answers)
    other.subscribe(
        "dwell/t/ask", lambda sample: other.put("dwell/t/answer/1", b"re " + sample.payload)
    )
    mesh.joined(lambda: bool(answers.samples), lambda: one.put("dwell/t/ask", b"who"))
    assert answers.payloads[0] == b"re who"


def test_a_process_may_come_back_in_its_place(mesh: Mesh) -> None:
    sender = mesh.open(FAR)
    for _ in range(2):  # it is the one that listens
        inbox = mesh.inbox()
        receiver = mesh.open(A)
        receiver.subscribe("dwell/t/order", inbox)
        introduce(mesh, sender, "dwell/t/order", [inbox])
        sender.put("dwell/t/order", b"again")
        mesh.until(lambda inbox=inbox: bool(inbox.samples))  # type: ignore[misc]
        receiver.close()
        assert inbox.payloads == [b"again"]


def test_closed_is_closed(mesh: Mesh) -> None:
    sender, receiver, other = mesh.open(A), mesh.open(FAR), mesh.open(B)
    inbox, witness = mesh.inbox(), mesh.inbox()
    receiver.subscribe("dwell/t/order", inbox)
    other.subscribe("dwell/t/**", witness)
    introduce(mesh, sender, "dwell/t/order", [inbox, witness])
    receiver.close()
    receiver.close()
    sender.put("dwell/t/order", b"too late")
    mesh.until(lambda: bool(witness.samples))
    receiver.put("dwell/t/done/x", b"from the dead")
    receiver.put("dwell/t/in/task/E/main", b"from the dead", lane="images")
    receiver.subscribe("dwell/t/order", inbox)
    sender.put("dwell/t/order", b"last")
    mesh.until(lambda: b"last" in witness.payloads)
    assert witness.payloads == [b"too late", b"last"]
    assert inbox.samples == []


@pytest.mark.parametrize("key", ["", "/a", "a/", "a//b", "a/*", " a", "a/@b", "a#b", "$x", "a?b"])
def test_what_is_no_key_is_refused(mesh: Mesh, key: str) -> None:
    with pytest.raises(LiveError, match="chunk"):
        mesh.open(A).put(key, b"")


@pytest.mark.parametrize("expression", ["", "a//b", "a*", "a/$*", "a/**/**", "a/**/*", "@/x"])
def test_what_is_no_key_expression_is_refused(mesh: Mesh, expression: str) -> None:
    with pytest.raises(LiveError, match="key expression"):
        mesh.open(A).subscribe(expression, mesh.inbox())


@pytest.mark.parametrize(
    "key", ["", "a//b", "/a", "a/", "a/@b", "a/b  c", "a\tb", "b /a", "a/*", "a/$b", "a?", "#"]
)
def test_a_key_that_nothing_can_be_sent_under(key: str) -> None:
    with pytest.raises(LiveError, match="is empty, starts with @, or has one of"):
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
