"""Source and sink against zenoh-ros2-sdk, and against a reader of plain Zenoh."""

from __future__ import annotations

import itertools
import json
import signal
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import zenoh

from dwell import ros2
from dwell.errors import LiveError
from dwell.live.ros2.rmw_zenoh import Attachment, RosEndpoint, RosNode, gid, read_token
from dwell.live.stage import CellActuator, CellStage, Message, StagePlace
from tests.live.ros2.ros_network import RosNetwork, kill, ros_network
from tests.waiting import wait_until

STRING, VECTOR = "std_msgs/msg/String", "geometry_msgs/msg/Vector3"
PLACE = StagePlace("hall", "camera", max_age_ms=60_000.0)


@pytest.fixture
def network() -> Iterator[RosNetwork]:
    with ros_network() as network:
        network.start_router()
        yield network


@contextmanager
def started(end: CellStage | CellActuator, place: StagePlace = PLACE) -> Iterator[None]:
    end.placed(place)
    end.check()
    end.start()
    try:
        yield
    finally:
        end.stop()


def applied(sink: ros2.Sink, command: Message) -> bool:
    try:
        sink.apply(command)
    except LiveError:
        return False
    return True


def arrives(sink: ros2.Sink, payload: object, heard: list[Any], expected: object) -> bool:
    """Publish a message, and return whether such a message has arrived."""
    applied(sink, Message(payload))
    time.sleep(0.05)
    return expected in heard


@contextmanager
def plain_session(network: RosNetwork) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([network.router]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


def test_messages_of_a_node_arrive(network: RosNetwork) -> None:
    network.talk("/chatter", STRING)
    source = ros2.Source("/chatter", STRING, connect=network.router)
    with started(source):
        source.wait()
        first = int(ros2.decode(source.process({}).payload, STRING).data)
        source.wait()
        assert int(ros2.decode(source.process({}).payload, STRING).data) > first
        report = source.report()
        assert report.ready
        assert report.topic is not None
        assert (report.topic.topic, report.topic.lost) == ("/chatter", 0)


def test_commands_arrive_at_a_node(network: RosNetwork) -> None:
    listener = network.listen("/robot/vec", VECTOR)
    sink = ros2.Sink("vec", VECTOR, namespace="/robot", connect=network.router)
    with started(sink):
        fields = {"x": 1.0, "y": 0.0, "z": -2.0}
        wait_until(lambda: arrives(sink, {"x": 1.0, "z": -2.0}, listener, fields), "fields")
        data = ros2.encode({"y": 0.5}, VECTOR)
        wait_until(
            lambda: arrives(sink, data, listener, {"x": 0.0, "y": 0.5, "z": 0.0}), "CDR bytes"
        )


def test_own_type_both_ways(network: RosNetwork, tmp_path: Path) -> None:
    kind, path = "own_msgs/msg/Wheels", tmp_path / "own_msgs" / "msg" / "Wheels.msg"
    path.parent.mkdir(parents=True)
    path.write_text("float64[4] speeds\nuint32 number\n")
    network.talk("/wheels", kind)
    listener = network.listen("/set", kind)
    place = StagePlace("hall", "wheels", folder=str(tmp_path), max_age_ms=60_000.0)
    source = ros2.Source("/wheels", kind, messages="own_msgs", connect=network.router)
    sink = ros2.Sink("/set", kind, messages="own_msgs", connect=network.router)
    with started(source, place), started(sink, place):
        source.wait()
        found = ros2.decode(source.process({}).payload, kind, path.parents[1])
        assert found.speeds.tolist() == [found.number + n for n in range(4)]
        fields = {"speeds": [1, 2, 3, 4], "number": 5}
        wait_until(lambda: arrives(sink, fields, listener, fields), "a message of the own type")


def test_wire_form_of_commands(network: RosNetwork) -> None:
    """A reader from the table of the protocol: key, attachment, and tokens that end."""
    arrived: list[tuple[str, bytes, bytes]] = []
    tokens: dict[str, RosNode | RosEndpoint] = {}

    def take(sample: Any) -> None:
        arrived.append(
            (str(sample.key_expr), sample.payload.to_bytes(), sample.attachment.to_bytes())
        )

    def token(sample: Any) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.DELETE:
            del tokens[key]
        else:
            tokens[key] = read_token(key)

    with plain_session(network) as session:
        session.declare_subscriber("5/vec/**", take)
        session.liveliness().declare_subscriber("@ros2_lv/5/**", token, history=True)
        sink = ros2.Sink("/vec", VECTOR, domain=5, connect=network.router, require_subscriber=False)
        with started(sink, StagePlace("hall", "control", 1)):
            wait_until(lambda: len(tokens) == 2, "a node and a publisher")
            node, publisher = sorted(tokens, key=len)
            wait_until(lambda: sink.report().ready, "a router")
            sent = itertools.count()

            def arrive() -> bool:
                sink.apply(Message({"x": float(next(sent))}))
                return len(arrived) >= 3

            # Zenoh drops messages before the publisher knows the reader, and on a busy machine.
            wait_until(arrive, "three messages")
        wait_until(lambda: not tokens, "the end of the tokens")
    found = read_token(publisher)
    assert isinstance(found, RosEndpoint)
    assert read_token(node) == found.node
    assert found.node.name == "dwell_hall_control_1"
    assert (found.kind, found.topic.name, found.topic.type) == ("MP", "/vec", VECTOR)
    sequences = []
    for key, payload, attachment in arrived:
        assert key == found.topic.key(5)
        sequence, sent_ns, length = struct.unpack("<qqB", attachment[:17])
        sequences.append(sequence)
        assert payload == b"\0\1\0\0" + struct.pack("<3d", sequence - 1, 0, 0)
        assert length == 16
        assert abs(sent_ns - time.time_ns()) < 600e9
        assert attachment[17:] == gid(publisher)
    assert sequences == sorted(set(sequences))


@contextmanager
def plain_publisher(
    network: RosNetwork, source: ros2.Source, topic: str, kind: str
) -> Iterator[Any]:
    """A publisher of plain Zenoh under the topic's key, once the source has subscribed."""
    key = f"0{topic}/{kind.replace('/', '::').replace('::msg::', '::msg::dds_::')}_/"
    with plain_session(network) as session:
        from dwell.live.ros2.message_types import message_types

        # A publisher that drops messages may lose some on a busy machine.
        publisher = session.declare_publisher(
            key + message_types().hash(kind), congestion_control=zenoh.CongestionControl.BLOCK
        )
        # Its type is declared as bool, and is not.
        wait_until(
            lambda: cast(Any, publisher.matching_status).matching, "the source's subscription"
        )
        yield publisher


def attached(sequence: int, source: bytes = b"\1" * 16) -> bytes:
    return Attachment(sequence, 1, source).pack()


def test_lost_messages_are_counted_by_publisher(network: RosNetwork) -> None:
    source = ros2.Source("/chatter", STRING, connect=network.router)
    with started(source), plain_publisher(network, source, "/chatter", STRING) as publisher:
        data = ros2.encode({"data": "x"}, STRING)
        for number, one in ((7, 1), (8, 1), (3, 2), (11, 1), (4, 2), (12, 1)):
            publisher.put(data, attachment=attached(number, bytes([one]) * 16))
        wait_until(lambda: source.rates().lost == 2, "two lost messages")
        source.wait()


def test_message_without_its_attachment_is_dropped(
    network: RosNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    source = ros2.Source("/chatter", STRING, connect=network.router)
    with started(source), plain_publisher(network, source, "/chatter", STRING) as publisher:
        for content in (None, b"short", None):
            publisher.put(ros2.encode({"data": "no"}, STRING), attachment=content)
        publisher.put(ros2.encode({"data": "yes"}, STRING), attachment=attached(1))
        source.wait()
        assert ros2.decode(source.process({}).payload, STRING).data == "yes"
    lines = [record.message for record in caplog.records]
    assert sum("without an attachment" in line for line in lines) == 1
    assert sum("an attachment of 5 bytes" in line for line in lines) == 1


def test_message_beyond_the_flow_is_dropped_by_name(
    network: RosNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    source = ros2.Source("/chatter", STRING, connect=network.router)
    place = StagePlace("hall", "camera", max_age_ms=60_000.0, payload_bytes=100_000)
    with started(source, place):
        with plain_publisher(network, source, "/chatter", STRING) as publisher:
            publisher.put(bytes(400_001), attachment=attached(1))
            publisher.put(ros2.encode({"data": "yes"}, STRING), attachment=attached(2))
            source.wait()
        assert ros2.decode(source.process({}).payload, STRING).data == "yes"
    assert any("a message of 400001 bytes is dropped" in one.message for one in caplog.records)


def test_image_arrives_as_an_array_with_its_stamp(network: RosNetwork) -> None:
    kind = "sensor_msgs/msg/Image"
    fields = {"height": 2, "width": 3, "encoding": "bgr8", "step": 9, "data": list(range(18))}
    data = ros2.encode({"header": {"stamp": {"sec": 4, "nanosec": 2}}, **fields}, kind)
    source = ros2.Source("/image", kind, "sensor_data", connect=network.router)
    with started(source), plain_publisher(network, source, "/image", kind) as publisher:
        publisher.put(data, attachment=attached(1))
        source.wait()
        message = source.process({})
    np.testing.assert_array_equal(message.payload, np.arange(18).reshape(2, 3, 3))
    assert message.stamp_ns == 4_000_000_002


def test_command_gets_the_stamp_of_its_frame(network: RosNetwork) -> None:
    kind, stamps = "geometry_msgs/msg/TwistStamped", []
    sink = ros2.Sink("/cmd", kind, connect=network.router, require_subscriber=False)
    with plain_session(network) as session, started(sink):
        session.declare_subscriber(
            "0/cmd/**",
            lambda one: stamps.append(ros2.decode(one.payload.to_bytes(), kind).header.stamp),
        )

        def seen(command: Message, sec: int, nanosec: int) -> bool:
            applied(sink, command)
            time.sleep(0.05)
            return (sec, nanosec) in [(one.sec, one.nanosec) for one in stamps]

        command = Message({}, stamp_ns=5_000_000_007)
        wait_until(lambda: seen(command, 5, 7), "a stamped command")
        encoded = Message(ros2.encode({}, kind), stamp_ns=3)
        wait_until(lambda: seen(encoded, 0, 3), "stamped bytes")


def test_late_source_gets_the_last_message(network: RosNetwork) -> None:
    kind = "std_msgs/msg/String"
    options = {"qos": "transient_local", "connect": network.router}
    sink = ros2.Sink("/map", kind, require_subscriber=False, **options)
    with started(sink, StagePlace("hall", "map")):
        wait_until(lambda: applied(sink, Message({"data": "old"})), "a router")
        source = ros2.Source("/map", kind, **options)
        with started(source):
            source.wait()
            assert ros2.decode(source.process({}).payload, kind).data == "old"


def test_silence_of_a_topic_fails_its_job_by_name(network: RosNetwork) -> None:
    talker = network.talk("/chatter", STRING)
    source = ros2.Source("/chatter", STRING, connect=network.router)
    with started(source, StagePlace("hall", "camera", max_age_ms=50.0)):
        source.wait()
        kill(talker)
        wait_until(lambda: not source.report().ready, "a report of silence")
        assert "/chatter: no message for" in source.report().note
        wait_until(lambda: "no publisher" in source.report().note, "the end of the token")
        with pytest.raises(LiveError, match=r"/chatter: no message for .*: no publisher"):
            source.process({})


def test_frozen_publisher_is_named_by_its_missing_messages(network: RosNetwork) -> None:
    talker = network.talk("/chatter", STRING)
    source = ros2.Source("/chatter", STRING, connect=network.router)
    with started(source, StagePlace("hall", "camera", max_age_ms=50.0)):
        source.wait()
        talker.send_signal(signal.SIGSTOP)
        try:
            wait_until(lambda: not source.report().ready, "a report of silence")
        finally:
            talker.send_signal(signal.SIGCONT)
        wait_until(lambda: source.report().ready, "the next message")


def test_publisher_of_another_type_is_an_error_with_both_names(network: RosNetwork) -> None:
    network.talk("/chatter", VECTOR)
    source = ros2.Source("/chatter", STRING, connect=network.router)
    with started(source):
        wait_until(lambda: VECTOR in source.report().note, "the publisher's token")
        assert f"as {VECTOR}, and dwell_hall_camera has {STRING}" in source.report().note
        assert not source.report().ready


def test_garbled_tokens_are_one_warning_and_all_else_goes_on(
    network: RosNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    garbled = "@ros2_lv/0/abc/0/1/MP/%/%/lidar/%chatter/type/RIHS01_XY/::"
    with plain_session(network) as session, session.liveliness().declare_token(garbled):
        network.talk("/chatter", STRING)
        source = ros2.Source("/chatter", STRING, connect=network.router)
        with started(source):
            source.wait()
            wait_until(lambda: any("lidar" in one.message for one in caplog.records), "a warning")
            (line,) = {one.message for one in caplog.records if "lidar" in one.message}
            assert "%chatter" in line


def test_commands_without_a_reader_are_not_applied(network: RosNetwork) -> None:
    sink = ros2.Sink("/vec", VECTOR, connect=network.router)
    with started(sink):
        wait_until(lambda: sink.report().ready, "a router")
        with pytest.raises(LiveError, match="/vec: no subscription"):
            sink.apply(Message({"x": 1.0}))


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_no_router_at_the_start_and_later_one(mode: str) -> None:
    with ros_network() as network:
        sink = ros2.Sink("/vec", VECTOR, connect=network.router, mode=mode)
        with started(sink):
            wait_until(lambda: f"no router at {network.router}" in sink.report().note, "a note")
            assert not sink.report().ready
            with pytest.raises(LiveError, match="no router at"):
                sink.apply(Message({"x": 1.0}))
            network.start_router()
            listener = network.listen("/vec", VECTOR)
            fields = {"x": 1.0, "y": 0.0, "z": 0.0}
            wait_until(lambda: arrives(sink, fields, listener, fields), "router and subscription")


def test_killed_router_and_its_successor_in_client_mode() -> None:
    with ros_network() as network:
        router = network.start_router()
        network.talk("/chatter", STRING)
        source = ros2.Source("/chatter", STRING, connect=network.router, mode="client")
        sink = ros2.Sink("/out", STRING, connect=network.router, mode="client")
        with started(source), started(sink):
            source.wait()
            kill(router)
            wait_until(lambda: "no router" in sink.report().note, "a note of the sink")
            with pytest.raises(LiveError, match="/out: no router at"):
                sink.apply(Message({"data": "x"}))
            network.start_router()
            wait_until(lambda: sink.report().ready and source.report().ready, "messages again")
            # The sink's token is back, too.
            tokens: list[str] = []
            with plain_session(network) as session:
                replies = session.liveliness().get("@ros2_lv/0/**")
                tokens = [str(one.ok.key_expr) for one in replies if one.ok is not None]
            assert any("/MP/" in token and "%out" in token for token in tokens)


def test_peers_go_on_without_the_router() -> None:
    with ros_network() as network:
        router = network.start_router()
        network.talk("/chatter", STRING)
        source = ros2.Source("/chatter", STRING, connect=network.router)
        with started(source):
            source.wait()
            wait_until(lambda: source.rates().rate_hz > 0, "a rate")
            time.sleep(1.0)  # the peers find each other through the router
            kill(router)
            source.wait()
            source.wait()
            assert source.report().ready


def test_zero_message_is_published_and_hold_publishes_nothing(network: RosNetwork) -> None:
    kind, heard = "geometry_msgs/msg/Twist", threading.Semaphore(0)
    payloads: list[bytes] = []

    def take(sample: Any) -> None:
        payloads.append(sample.payload.to_bytes())
        heard.release()

    sink = ros2.Sink("/cmd", kind, connect=network.router, require_subscriber=False)
    with plain_session(network) as session, started(sink):
        session.declare_subscriber("0/cmd/**", take)
        wait_until(lambda: sink.report().ready, "a router")

        def zeroed() -> bool:
            sink.hold()
            sink.zero()
            return heard.acquire(timeout=0.2)

        wait_until(zeroed, "a zero message")
    assert set(payloads) == {b"\0\1\0\0" + bytes(48)}
    # A type without a message that stops: zero() publishes nothing, with or without a router.
    ros2.Sink("/joints", "trajectory_msgs/msg/JointTrajectory").zero()
