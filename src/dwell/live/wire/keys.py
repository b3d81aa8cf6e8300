"""The keys under which the processes of a cell send and hear."""

from __future__ import annotations

MAIN, SHADOW = "main", "shadow"
#: Who orders, among those who have keys; all others of a cell go by their node's name.
CONTROLLER = "controller"
#: First words of the keys of what is sent twice: nothing else takes the detour.
TWICE = frozenset({"accepted", "beat", "done", "ended", "load"})


class Keys:
    """Keys of one cell."""

    def __init__(self, cell: str) -> None:
        self.root = f"dwell/{cell}"
        self._below, self._detoured = f"{self.root}/", f"{self.root}/detour/"

    def inputs(self, task: str, node: str, kind: str = MAIN) -> str:
        """Inputs of a task's worker; of its shadow worker where `kind` is `SHADOW`."""
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

    def stamped(self) -> str:
        """The stamp of every cycle."""
        return f"{self.root}/stamped"

    def frame(self) -> str:
        """Requests to the stamper for a cycle, because the source has a frame."""
        return f"{self.root}/frame"

    def order(self) -> str:
        """Orders of the controller."""
        return f"{self.root}/order"

    def accepted(self) -> str:
        """Answers to them."""
        return f"{self.root}/accepted"

    def load(self, node: str) -> str:
        """Reports of a node's CPU."""
        return f"{self.root}/load/{node}"

    def snapshot(self, task: str, node: str) -> str:
        """Requests to a worker for its state."""
        return f"{self.root}/snapshot/{task}/{node}"

    def state(self, task: str, node: str, source: str = "*") -> str:
        """States on their way to a worker from the one on another node; ``*`` for all nodes."""
        return f"{self.root}/state/{task}/{node}/{source}"

    def restored(self) -> str:
        """Reports that a state has arrived."""
        return f"{self.root}/restored"

    def ask(self) -> str:
        """Questions and wishes of a person to the controller."""
        return f"{self.root}/ask"

    def look(self) -> str:
        """Questions for the controller's status, and nothing else."""
        return f"{self.root}/look"

    def answer(self, number: str) -> str:
        """Answers to them; ``*`` for all."""
        return f"{self.root}/answer/{number}"

    def relay(self, key: str) -> str:
        """The copy of a message for the relay; ``**`` below the root for all."""
        return f"{self.root}/relay/{key.removeprefix(self.root + '/')}"

    def detour(self, key: str) -> str:
        """The copy as it arrives."""
        return f"{self.root}/detour/{key.removeprefix(self.root + '/')}"

    def came_directly(self, key: str) -> bool:
        """Whether a message did not come over the detour."""
        return not key.startswith(self._detoured)

    def word(self, key: str) -> str:
        """Return the first word of a key, whichever way its message came: its kind."""
        return key.removeprefix(self._below).removeprefix("detour/").partition("/")[0]

    def carried(self) -> str:
        """All copies of a while, together."""
        return f"{self.root}/carried"

    def gathered(self) -> str:
        """The same for the controller, less often."""
        return f"{self.root}/gathered"
