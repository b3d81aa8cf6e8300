from __future__ import annotations

from dwell.live.wire.keys import Keys

KEYS = Keys("hall")


def test_a_copy_is_known_for_what_it_is_and_how_it_came() -> None:
    direct = KEYS.beat("R1", "sensing@R1")
    copy = KEYS.detour(direct)
    assert KEYS.came_directly(direct)
    assert not KEYS.came_directly(copy)
    assert KEYS.word(direct) == KEYS.word(copy) == "beat"
    assert KEYS.relay(direct) == "dwell/hall/relay/beat/R1/sensing@R1"


def test_cells_and_kinds_of_messages_have_keys_of_their_own() -> None:
    makers = [
        *(KEYS.inputs("plan", "E"), KEYS.inputs("plan", "E", "shadow"), KEYS.command("plan")),
        *(KEYS.done("plan"), KEYS.ended(), KEYS.beat("E", "plan"), KEYS.stamped(), KEYS.frame()),
        *(KEYS.order(), KEYS.accepted(), KEYS.load("E"), KEYS.snapshot("plan", "E")),
        *(KEYS.state("plan", "E"), KEYS.restored(), KEYS.ask(), KEYS.look(), KEYS.answer("1")),
        *(KEYS.carried(), KEYS.gathered()),
    ]
    assert len(set(makers)) == len(makers)
    assert all(key.startswith("dwell/hall/") for key in makers)
    assert Keys("yard").order() != KEYS.order()
