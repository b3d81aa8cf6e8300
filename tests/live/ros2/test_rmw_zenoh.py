"""Names and bytes of rmw_zenoh, held against other implementations and values computed by hand."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh_ros2_sdk.attachment import Attachment as SdkAttachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import (
    endpoint_liveliness_keyexpr,
    node_liveliness_keyexpr,
    topic_keyexpr,
)
from zenoh_ros2_sdk.qos import QosProfile
from zenoh_ros2_sdk.qos import QosReliability as Reliability

from dwell.errors import LiveError
from dwell.live.ros2.rmw_zenoh import (
    NO_HASH,
    QOS,
    Attachment,
    RosEndpoint,
    RosNode,
    Topic,
    TopicQos,
    gid,
    node_name,
    read_token,
)
from dwell.live.stage import StagePlace

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
IMAGE = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
ZID = "1234567890abcdef1234567890abcdef"
CHATTER = Topic("/chatter", "std_msgs/msg/String", STRING)
TALKER = RosNode(0, ZID, 0, "talker")
CAMERA = RosEndpoint(
    RosNode(7, "aabb", 0, "dwell_hall_camera", "/robot"),
    1,
    "MS",
    Topic("/robot/camera", "sensor_msgs/msg/Image", IMAGE),
    QOS["sensor_data"],
)
#: Tokens, and their ids by `XXH3_128bits` of the C library xxHash 0.8.1.
GIDS = {
    f"@ros2_lv/0/{ZID}/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING}/"
    "::,10:,:,:,,": "60cf8ab0dfe17da147274ffa76a2737d",
    "@ros2_lv/7/aabb/0/1/MS/%/%robot/dwell_hall_camera/%robot%camera/"
    f"sensor_msgs::msg::dds_::Image_/{IMAGE}/2::,5:,:,:,,": "0f60a0112238dc4061f559e68ddab21e",
    "@ros2_lv/0/1/0/0/NN/%/%/n": "b4d15b855bf91fc3aa0bf846b348653d",
}


def test_key_of_a_topic_keeps_inner_slashes() -> None:
    inner = Topic("/ns/topic", "std_msgs/msg/String", STRING)
    assert inner.key(3) == f"3/ns/topic/std_msgs::msg::dds_::String_/{STRING}"
    assert CHATTER.key(0) == topic_keyexpr(0, "/chatter", "std_msgs::msg::dds_::String_", STRING)


def test_tokens_of_endpoints() -> None:
    talker = RosEndpoint(TALKER, 1, "MP", CHATTER, QOS["default"])
    tokens = [talker.token(), CAMERA.token(), RosNode(0, "1", 0, "n").token()]
    assert tokens == list(GIDS)


@pytest.mark.parametrize(("token", "expected"), GIDS.items())
def test_gid_is_the_hash_of_the_c_library(token: str, expected: str) -> None:
    assert gid(token).hex() == expected


def test_tokens_are_those_of_the_sdk() -> None:
    node = NodeEntity(7, "aabb", 0, "dwell_hall_camera", "/robot")
    qos = QosProfile(reliability=Reliability.BEST_EFFORT, history_depth=5).encode()
    kind, dds = EntityKind.SUBSCRIPTION, "sensor_msgs::msg::dds_::Image_"
    theirs = EndpointEntity(node, 1, kind, "/robot/camera", dds, IMAGE, qos)
    assert CAMERA.token() == endpoint_liveliness_keyexpr(theirs)
    assert CAMERA.node.token() == node_liveliness_keyexpr(node)


@given(
    st.builds(
        RosEndpoint,
        st.builds(
            RosNode,
            st.integers(0, 232),
            st.just(ZID),
            st.integers(0, 99),
            st.from_regex("[a-z_]{1,9}", fullmatch=True),
            st.sampled_from(["", "/robot", "/hall/robot"]),
        ),
        st.integers(0, 99),
        st.sampled_from(["MP", "MS"]),
        st.sampled_from([CHATTER, CAMERA.topic, Topic("/a/b", "own/msg/X", NO_HASH)]),
        st.builds(TopicQos, st.booleans(), st.booleans(), st.integers(0, 1000)),
    )
)
def test_tokens_are_read_as_they_are_written(endpoint: RosEndpoint) -> None:
    assert read_token(endpoint.token()) == endpoint
    assert read_token(endpoint.node.token()) == endpoint.node


def test_token_with_a_chunk_of_backends() -> None:
    assert read_token(f"{CAMERA.token()}/cuda,cpu") == CAMERA


def test_token_of_hiroz_with_all_defaults() -> None:
    """A token of its tests, taken from rmw_zenoh_cpp."""
    token = (
        "@ros2_lv/123/1234567890abcdef1234567890abcdef/1/2/MP/%/%/res_gateway/"
        "%res%statuslight%autonomy/frost_msgs%msg%StatuslightRpdo1/"
        "RIHS01_0000000000000000000000000000000000000000000000000000000000000000/::,:,:,:,,:"
    )
    found = read_token(token)
    assert isinstance(found, RosEndpoint)
    assert found.node == RosNode(123, ZID, 1, "res_gateway")
    assert (found.number, found.kind, found.topic.name) == (2, "MP", "/res/statuslight/autonomy")
    assert found.topic.type == "frost_msgs/msg/StatuslightRpdo1"
    assert found.qos == TopicQos(depth=42)


GARBLED = {
    "another space": "not_admin_space/0/1/2/3/NN/%/%/node",
    "cut off": "@ros2_lv/0/1234",
    "domain": "@ros2_lv/notanumber/0/0/0/NN/%/%/node",
    "kind": "@ros2_lv/0/0/0/0/XX/%/%/node",
    "endpoint without a topic": "@ros2_lv/0/0/0/0/MP/%/%/node",
    "hash": CAMERA.token().replace(IMAGE, "RIHS01_ZZ"),
    "reliability": CAMERA.token().replace("/2::", "/x::"),
    "short QoS": CAMERA.token().replace("2::,5:,:,:,,", "2::,5"),
    "depth": CAMERA.token().replace(",5:", ",five:"),
}


@pytest.mark.parametrize("token", GARBLED.values(), ids=GARBLED.keys())
def test_garbled_token(token: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - of any text
        read_token(token)


def test_attachment_by_hand_and_by_the_sdk() -> None:
    number, sent_ns, source = 5, 1_700_000_000_000_000_001, bytes(range(16))
    ours = Attachment(number, sent_ns, source)
    data = struct.pack("<qq", number, sent_ns) + b"\x10" + source
    assert ours.pack() == data == SdkAttachment(number, sent_ns, source).to_bytes()
    assert Attachment.read(data) == ours


@pytest.mark.parametrize("data", [b"", bytes(32), bytes(33), bytes(34), b"\x10" * 16 + b"\x08"])
def test_another_attachment(data: bytes) -> None:
    with pytest.raises(LiveError, match=f"an attachment of {len(data)} bytes"):
        Attachment.read(data)


@pytest.mark.parametrize(
    ("place", "name"),
    [
        (StagePlace("hall", "camera"), "dwell_hall_camera"),
        (StagePlace("my cell-1", "cam.left", 1), "dwell_my_cell_1_cam_left_1"),
        (StagePlace("häll", "a__b"), "dwell_h_ll_a_b"),
    ],
)
def test_names_of_nodes(place: StagePlace, name: str) -> None:
    assert node_name(place) == name
