from __future__ import annotations

from dwell.live.wire import channels
from dwell.live.wire.channels import CHANNELS
from dwell.live.wire.keys import Keys

KEYS = Keys("hall")


def test_a_copy_is_known_for_what_it_is_and_how_it_came() -> None:
    direct = KEYS.of(channels.BEAT, "R1", "sensing@R1")
    copy = KEYS.detour(direct)
    assert KEYS.came_directly(direct)
    assert not KEYS.came_directly(copy)
    assert KEYS.word(direct) == KEYS.word(copy) == "beat"
    assert KEYS.relay(direct) == "dwell/hall/relay/beat/R1/sensing@R1"


def test_cells_and_channels_have_keys_of_their_own() -> None:
    keys = [KEYS.all(channel) for channel in CHANNELS.values()]
    assert len(set(keys)) == len(keys)
    assert all(key.startswith("dwell/hall/") for key in keys)
    assert Keys("yard").of(channels.ORDER) != KEYS.of(channels.ORDER)
