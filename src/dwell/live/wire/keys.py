"""Keys of the messages between the processes of a cell."""

from __future__ import annotations

MAIN, SHADOW = "main", "shadow"
#: Signing name of the controller; other processes sign with the name of their node.
CONTROLLER = "controller"
#: First words of the keys of messages that are sent twice, directly and over the detour.
TWICE = frozenset({"accepted", "beat", "done", "ended", "load"})
#: First words of the keys of beats, and of all messages that the relay passes on.
BEATS = frozenset({"beat", "beats"})
RELAYED = TWICE | BEATS


class Keys:
    """Keys of one cell."""

    def __init__(self, cell: str) -> None:
        self.root = f"dwell/{cell}"
        self._below, self._detoured = f"{self.root}/", f"{self.root}/detour/"

    def inputs(self, task: str, node: str, kind: str = MAIN) -> str:
        """Inputs of a task's worker, or of its shadow worker if `kind` is `SHADOW`."""
        return f"{self.root}/in/{task}/{node}/{kind}"

    def command(self, task: str) -> str:
        """Commands of a sink task to its actuator."""
        return f"{self.root}/sink/{task}"

    def done(self, sink: str) -> str:
        """Completions of a sink; ``*`` for all."""
        return f"{self.root}/done/{sink}"

    def ended(self) -> str:
        """Completions of cycles and shadows that ended before a sink."""
        return f"{self.root}/ended"

    def beat(self, node: str, who: str) -> str:
        """Heartbeats; ``*`` for all nodes or processes."""
        return f"{self.root}/beat/{node}/{who}"

    def beats(self, node: str) -> str:
        """Heartbeats of all processes of a node, from its agent; ``*`` for all nodes."""
        return f"{self.root}/beats/{node}"

    def missed(self) -> str:
        """Requests of the stamper to the relay for the beats that it misses."""
        return f"{self.root}/missed"

    def stamped(self) -> str:
        """Stamps of all cycles."""
        return f"{self.root}/stamped"

    def frame(self) -> str:
        """Requests to the stamper for a cycle, because the source has a frame."""
        return f"{self.root}/frame"

    def order(self) -> str:
        """Orders of the controller."""
        return f"{self.root}/order"

    def accepted(self) -> str:
        """Answers to the orders."""
        return f"{self.root}/accepted"

    def load(self, node: str) -> str:
        """Reports of a node's CPU."""
        return f"{self.root}/load/{node}"

    def snapshot(self, task: str, node: str) -> str:
        """Requests to a worker for its state."""
        return f"{self.root}/snapshot/{task}/{node}"

    def state(self, task: str, node: str, source: str = "*") -> str:
        """States sent to a task's worker from its worker on a source node; ``*`` for all nodes."""
        return f"{self.root}/state/{task}/{node}/{source}"

    def restored(self) -> str:
        """Reports that a state was restored."""
        return f"{self.root}/restored"

    def ask(self) -> str:
        """Requests of operators to the controller."""
        return f"{self.root}/ask"

    def look(self) -> str:
        """Requests for the controller's status only."""
        return f"{self.root}/look"

    def answer(self, number: str) -> str:
        """Answers to requests, by their number; ``*`` for all."""
        return f"{self.root}/answer/{number}"

    def relay(self, key: str) -> str:
        """Copy of a message, sent to the relay; ``**`` below the root for all."""
        return f"{self.root}/relay/{key.removeprefix(self.root + '/')}"

    def detour(self, key: str) -> str:
        """Copy of a message, received over the detour."""
        return f"{self.root}/detour/{key.removeprefix(self.root + '/')}"

    def came_directly(self, key: str) -> bool:
        """Whether a message did not come over the detour."""
        return not key.startswith(self._detoured)

    def word(self, key: str) -> str:
        """Return the kind of a message, the first word of its key after any ``detour``."""
        return key.removeprefix(self._below).removeprefix("detour/").partition("/")[0]

    def carried(self) -> str:
        """Batches of copies from the relay."""
        return f"{self.root}/carried"

    def gathered(self) -> str:
        """Batches of copies for the controller, less frequent."""
        return f"{self.root}/gathered"
