"""State transfer: snapshots of a task's state, their restoration on another node, checkpoints."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from dwell.errors import LiveError
from dwell.live.roles.control_group import UNKNOWN
from dwell.live.roles.joins import MAX_JOINS, Job
from dwell.live.roles.role import RolePlace
from dwell.live.stage import CellStage
from dwell.live.wire import channels
from dwell.live.wire.messages import Restored, Snapshot, State, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import SPARE, lane_of, longest_bytes
from dwell.model.instants import NEVER_NS
from dwell.model.placement import nodes_of

#: Least time between two checkpoints, as a multiple of the cost of a checkpoint.
CHECKPOINT_SPACING = 20


@dataclass(frozen=True, slots=True)
class Chore:
    """A call of the stage between two jobs: snapshot() for the nodes `to`, or restore().

    `number` is the number of the request, 0 for a checkpoint; `state` and `data` are the state to
    restore.
    """

    to: tuple[str, ...] = ()
    number: int = 0
    state: State | None = None
    data: bytes = b""

    @property
    def call(self) -> str:
        """Name of the call."""
        return "snapshot()" if self.state is None else "restore()"


class StateTransfer:
    """State of a worker's stage: it is sent, restored, and kept in checkpoints.

    `failed` reports a failure of the stage and returns its text. Shadows keep no state.
    """

    def __init__(
        self,
        place: RolePlace,
        task: str,
        stage: CellStage,
        failed: Callable[[str], str],
        *,
        shadow: bool,
    ) -> None:
        self.place, self.task, self.stage, self._failed = place, task, stage, failed
        declared = place.problem.pipeline.tasks[task]
        self._rate = place.problem.pipeline.rates[task]
        self._state_bytes, self._nodes = declared.state_bytes, frozenset(declared.on)
        self.stateful = stage.stateful and not shadow
        #: Requests for the state here by new node, and request for a state to be sent here.
        self.asked: dict[str, Snapshot] = {}
        self.awaited: Snapshot | None = None
        # Received states and checkpoints by sending node.
        self._answers: dict[str, tuple[State, bytes]] = {}
        self._checkpoints: dict[str, tuple[State, bytes]] = {}
        #: Run and cycle of the newest stamp that has arrived with an input.
        self._newest = (-1, -1)
        # Jobs forked to here ahead of a migration; jobs to process after restoring the state.
        self.forked: deque[Job] = deque(maxlen=10 * MAX_JOINS)
        self.replay: deque[Job] = deque(maxlen=10 * MAX_JOINS)
        self._follows = False
        self._restored: Restored | None = None
        # Run and cycle of the last job in the state, of the restored state, and of the last job
        # that the placement assigned to this worker.
        self.at = self.restored_at = self._worked_at = (-1, -1)
        # Nodes for which a checkpoint is due; duration of the last snapshot, made here or received,
        # and the end of the last one made here.
        self._checkpoint_to: tuple[str, ...] = ()
        self._cost_ns, self._snapshot_ns = 0, -NEVER_NS

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""
        if self.stateful:
            keys, node = self.place.keys, self.place.node
            yield keys.of(channels.SNAPSHOT, self.task, node)
            yield keys.of(channels.STATE, self.task, node, "*")

    def stamped(self, cycle: tuple[int, int]) -> None:
        """Record the run and cycle of a stamp that has arrived with an input."""
        self._newest = max(self._newest, cycle)

    def fork(self, job: Job) -> None:
        """Keep a job that was sent here only because the state will move here."""
        self.forked.append(job)
        if self._follows:
            self.replay.append(job)

    def worked(self, job: Job) -> None:
        """Record a job that the placement assigned to this worker."""
        self._worked_at = max(self._worked_at, job.order)
        self._follows = False
        self.awaited = None
        self.forked.clear()

    @property
    def pending(self) -> bool:
        """Whether a chore, a report or a job to process again may be due."""
        due = self.replay or self._checkpoint_to or self._restored or self.asked or self._restoring
        return bool(due)

    def next_chore(self) -> Chore | None:
        """Return the chore before the next job; `call` and `finish` must follow."""
        asked = next(iter(self.asked.values()), None)
        if asked is not None and self.at >= self._last_before(asked):
            del self.asked[asked.to]
            chore = Chore((asked.to,), asked.number)
        elif (found := self._restoring) is not None:
            self.awaited = None
            self._answers.clear()
            chore = Chore((), found[0].number, *found)
        elif self._checkpoint_to:
            chore = Chore(self._checkpoint_to)
        else:
            return None
        self._checkpoint_to = ()
        return chore

    def receive(self, sample: Arrival) -> None:
        """Process a request for a state, or a state; raise a LiveError if it is invalid."""
        if "/snapshot/" in sample.key:
            asked = self.place.read(channels.SNAPSHOT, sample)
            if asked.task == self.task and asked.node == self.place.node:
                self.asked[asked.to] = asked
            elif asked.task == self.task and asked.to == self.place.node:
                self.awaited = asked
            return
        state = decode(sample.header, State)
        if state.task != self.task:
            raise LiveError(f"a state of {state.task} came to {self.task}")
        if not sample.key.endswith(f"/{state.node}") or state.node not in self._nodes:
            raise LiveError(f"{sample.key}: a state of {state.task} on {state.node}")
        length, longest = len(sample.payload), longest_bytes(self._state_bytes)
        if length > longest:
            raise LiveError(f"{self.task}: a state of {length} bytes; at most {longest} are taken")
        kept = self._answers if state.number else self._checkpoints
        kept[state.node] = state, sample.payload
        self._cost_ns = self._cost_ns or state.cost_ns

    @property
    def _restoring(self) -> tuple[State, bytes] | None:
        """The requested state, if it has arrived and the stamp of its last cycle is known here.

        Inputs of later cycles are forked to here.
        """
        asked = self.awaited
        found = None if asked is None else self._answers.get(asked.node)
        if asked is None or found is None or found[0].number != asked.number:
            return None
        return found if self._last_before(asked) <= found[0].key <= self._newest else None

    def _last_before(self, asked: Snapshot) -> tuple[int, int]:
        """Run and cycle of the last job before the first forked one."""
        last = asked.cycle - 1
        return asked.run, last - last % self._rate

    def call(self, chore: Chore) -> tuple[bytes, str]:
        """Call the stage; return the snapshot, and the error or an empty string."""
        state = chore.state
        if state is None:
            try:
                return bytes(self.stage.snapshot()), ""
            except Exception as error:  # the user's code
                return b"", f"snapshot() failed ({type(error).__name__}: {error})"
        if state.key < self._worked_at:
            cycle = self._worked_at[1]
            return b"", f"{self.task}: a state of cycle {state.cycle} came after one of {cycle}"
        if state.key < self.restored_at:
            return b"", ""
        return b"", self._take_over(state, chore.data)

    def finish(
        self, chore: Chore, data: bytes, failed: str, started_ns: int, ended_ns: int
    ) -> None:
        """Send the snapshot, or queue the forked jobs that follow a restored state."""
        state = chore.state
        if state is None:
            self._cost_ns, self._snapshot_ns = max(ended_ns - started_ns, 0), ended_ns
            if failed:
                self._failed(failed)
            else:
                self._send_state(chore, data)
            return
        if not failed and state.key == self.restored_at:
            self._follows = True
            self.replay.clear()
            self.replay.extend(job for job in self.forked if job.order > self.at)
        who = state.number, self.task, self.place.node
        self._restored = Restored(*who, *state.key, failed)
        if failed:
            self.report()

    def report(self) -> None:
        """Report a restored state once."""
        if self._restored is not None:
            self.place.send(channels.RESTORED, self._restored)
            self._restored = None

    def _send_state(self, chore: Chore, data: bytes) -> None:
        place = self.place
        run, cycle = (max(part, 0) for part in self.at)
        if len(data) > (longest := longest_bytes(self._state_bytes)):
            self._failed(too_long(f"its state of {len(data)}", longest, "state_bytes"))
            return
        state = State(run, cycle, self.task, place.node, chore.number, self._cost_ns)
        header, lane = encode(state), lane_of(self._state_bytes)
        for node in chore.to:
            key = place.keys.of(channels.STATE, self.task, node, place.node)
            place.transport.put(key, data, header, lane=lane)

    def _take_over(self, state: State, data: bytes) -> str:
        """Restore a state; return the error, or an empty string."""
        if not self.stage.stateful:
            return f"{self.task} has no restore()"
        try:
            self.stage.restore(data)
        except Exception as error:  # the user's code
            return self._failed(f"restore() failed ({type(error).__name__}: {error})")
        self.at = self.restored_at = state.key
        return ""

    def recover(self, job: Job) -> int:
        """Restore the last checkpoint if it is newer than this state; return its age in cycles."""
        if not self._checkpoints:
            return UNKNOWN
        kept, self._checkpoints = self._checkpoints.values(), {}
        # This job can only continue a checkpoint of an earlier cycle of its run.
        past = (max(self.at, (job.header.stamp.run, -1)), job.order)
        fit = [(state, data) for state, data in kept if past[0] < state.key < past[1]]
        if not fit:
            return UNKNOWN
        state, data = max(fit, key=lambda one: one[0].key)
        if self._take_over(state, data):
            return UNKNOWN
        return job.header.stamp.cycle - state.cycle

    @property
    def _checkpoint_nodes(self) -> tuple[str, ...]:
        """Other nodes on which fallbacks run this task; they get checkpoints."""
        problem = self.place.problem
        if not (self.stateful and problem.live.checkpoint_cycles):
            return ()
        nodes = {problem.candidates[name].first[self.task] for name in problem.controller.fallbacks}
        return tuple(sorted(nodes - {self.place.node}))

    @property
    def _too_slow(self) -> bool:
        """Whether a checkpoint takes so long that the guard would move the cell."""
        return self._cost_ns > self.place.problem.guard_patience_ns

    def plan_checkpoint(self, job: Job, now_ns: int) -> None:
        """Plan a checkpoint every `checkpoint_cycles` jobs, for at most 1/20 of the time."""
        problem, stamp = self.place.problem, job.header.stamp
        # A node that runs the task in this cycle needs no checkpoint.
        running = nodes_of(problem.candidates[stamp.placement][self.task])
        nodes = tuple(node for node in self._checkpoint_nodes if node not in running)
        number = stamp.cycle // self._rate
        if not nodes or number % problem.live.checkpoint_cycles:
            return
        rests = 0 <= now_ns - self._snapshot_ns < CHECKPOINT_SPACING * self._cost_ns
        if not (rests or self._too_slow):
            self._checkpoint_to = nodes

    def note(self) -> str:
        """Return why no checkpoints are made; empty if they are, or are not needed."""
        if not (self._too_slow and self._checkpoint_nodes):
            return ""
        cost_s, period_ms = self._cost_ns / 1e9, self.place.period_ns / 1e6
        call = f"{self.task}@{self.place.node}'s snapshot()"
        return f"no checkpoints: {call} takes {cost_s:.2g} s of a period of {period_ms:g} ms"


def too_long(what: str, longest: int, declared: str = "") -> str:
    """Return the error of a payload that is too long, and the key that permits it."""
    more = f"; raise {declared}, {SPARE} times which may be sent" if declared else ""
    return f"{what} bytes is not sent: at most {longest} are{more}"
