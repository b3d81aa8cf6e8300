"""The loop of the demo in simulated time: the stages themselves, with delays of a test's choice."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dwell.live.stage import Message
from examples.visual_servoing.servoing.arm import Arm
from examples.visual_servoing.servoing.camera import Sensing, read_mark, write_mark
from examples.visual_servoing.servoing.control import Control
from examples.visual_servoing.servoing.horizon import HorizonSettings
from examples.visual_servoing.servoing.messages import Plan
from examples.visual_servoing.servoing.perception import Perception
from examples.visual_servoing.servoing.planning import Planning
from examples.visual_servoing.servoing.scene import Scene
from examples.visual_servoing.servoing.world import World

PERIOD_NS = 40_000_000


@dataclass
class Loop:
    """One arm, one camera, and the stages between them.

    A cycle's picture is taken at its release; its pose is planned from after `perceived_ns`, and
    its command applied after `actuated_ns` from the release.
    """

    folder: Path
    scene: Scene = field(default_factory=Scene)
    perceived_ns: Callable[[int], int] = lambda cycle: 12_000_000
    actuated_ns: Callable[[int], int] = lambda cycle: 20_000_000
    lost: Callable[[int], bool] = lambda cycle: False
    covered: Callable[[int], bool] = lambda cycle: False
    start_ns: int = 1_000_000_000_000
    settings: HorizonSettings | None = None

    def __post_init__(self) -> None:
        self.now_ns = self.start_ns
        path = self.folder / "world"
        self.world = World.create(path, self.scene, self.start_ns)
        self.sensing = Sensing(path, clock=self.clock)
        self.perception = Perception(self.scene)
        self.planning = Planning(self.scene, self.settings, clock=self.clock)
        self.control = Control(clock=self.clock)
        self.arm = Arm(path, clock=self.clock)
        self.plans: list[Plan] = []

    def clock(self) -> int:
        return self.now_ns

    def play(self, cycles: range) -> NDArray[np.float64]:
        """Play cycles and return the error in mm every 5 ms; shape (n,)."""
        events: list[tuple[int, int, str, int, Message]] = []
        order = itertools.count()

        def plan_event(at_ns: int, kind: str, cycle: int, payload: object) -> None:
            released_ns = self.start_ns + cycle * PERIOD_NS
            message = Message(payload, cycle, released_ns)
            heapq.heappush(events, (at_ns, next(order), kind, cycle, message))

        for cycle in cycles:
            plan_event(self.start_ns + cycle * PERIOD_NS, "release", cycle, None)
        first, last = (self.start_ns + edge * PERIOD_NS for edge in (cycles.start, cycles.stop))
        for at_ns in range(first, last, 5_000_000):
            plan_event(at_ns, "look", 0, None)
        errors = []
        while events and events[0][0] < last:
            self.now_ns, _, kind, cycle, message = heapq.heappop(events)
            released_ns = self.start_ns + cycle * PERIOD_NS
            if kind == "look":
                errors.append(self.world.errors(self.now_ns)[0])
            elif kind == "release":
                picture = self.sensing.process({"stamper": message}).payload
                if self.covered(cycle):
                    mark = read_mark(picture)
                    picture = np.full_like(picture, 90)
                    write_mark(picture, mark)
                pose = self.perception.process({"sensing": Message(picture)}).payload
                if not self.lost(cycle):
                    plan_event(released_ns + self.perceived_ns(cycle), "plan", cycle, pose)
            elif kind == "plan":
                plan = self.planning.process({"perception": message}).payload
                self.plans.append(plan)
                at_ns = max(self.now_ns, released_ns + self.actuated_ns(cycle))
                plan_event(at_ns, "actuate", cycle, plan)
            else:
                command = self.control.process({"planning": message})
                self.arm.apply(command)
        return np.array(errors)


def rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(errors**2)))
