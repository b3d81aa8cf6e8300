"""The model of `peer-chain.yaml` in SimPy: what one would otherwise write in an afternoon.

`python simpy_chain.py CYCLES process|store` prints one line of JSON. `process` is the usual way, a
process a cycle that requests resources; `store` is a leaner one, a process a node with a queue, and
callbacks for the links. Drawing, simulating and the windows' metrics are timed.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import simpy
from numpy.typing import NDArray

PERIOD_MS = DEADLINE_MS = 33.0
WINDOW_CYCLES = 100
SIGMA = 0.3
MEAN_MS = (2.0, 8.0, 6.0, 2.0)

Events = Generator[Any, Any, None]


def draw(cycles: int) -> tuple[list[list[float]], list[list[float]]]:
    """Execution times (cycles, 4) and delays (cycles, 2), milliseconds."""
    rng = np.random.Generator(np.random.SFC64(1))
    mu = np.log(MEAN_MS) - SIGMA * SIGMA / 2
    work = rng.lognormal(mu, SIGMA, size=(cycles, 4))
    delay = np.maximum(0.2, 3.0 + rng.standard_normal((cycles, 2)))
    return work.tolist(), delay.tolist()


def run_process(cycles: int) -> list[float]:
    """Simulate with a process a cycle."""
    work, delay = draw(cycles)
    env = simpy.Environment()
    r1, edge, r2 = simpy.Resource(env), simpy.Resource(env), simpy.Resource(env)
    latency = [0.0] * cycles

    def job(k: int) -> Events:
        begin = env.now
        work_1, work_2, work_3, work_4 = work[k]
        delay_1, delay_2 = delay[k]
        with r1.request() as turn:
            yield turn
            yield env.timeout(work_1)
        yield env.timeout(delay_1)
        with edge.request() as turn:
            yield turn
            yield env.timeout(work_2)
        with edge.request() as turn:
            yield turn
            yield env.timeout(work_3)
        yield env.timeout(delay_2)
        with r2.request() as turn:
            yield turn
            yield env.timeout(work_4)
        latency[k] = env.now - begin

    def source() -> Events:
        for k in range(cycles):
            env.process(job(k))
            yield env.timeout(PERIOD_MS)

    env.process(source())
    env.run()
    return latency


def run_store(cycles: int) -> list[float]:
    """Simulate with a process a node."""
    work, delay = draw(cycles)
    env = simpy.Environment()
    queue_1, queue_e, queue_2 = simpy.Store(env), simpy.Store(env), simpy.Store(env)
    latency = [0.0] * cycles

    def later(delay_ms: float, queue: Any, item: object) -> None:
        env.timeout(delay_ms).callbacks.append(lambda _event: queue.put(item))

    def r1() -> Events:
        while True:
            k = yield queue_1.get()
            yield env.timeout(work[k][0])
            later(delay[k][0], queue_e, (1, k))

    def edge() -> Events:
        while True:
            task, k = yield queue_e.get()
            yield env.timeout(work[k][task])
            if task == 1:
                queue_e.put((2, k))
            else:
                later(delay[k][1], queue_2, k)

    def r2() -> Events:
        while True:
            k = yield queue_2.get()
            yield env.timeout(work[k][3])
            latency[k] = env.now - k * PERIOD_MS

    def source() -> Events:
        for k in range(cycles):
            queue_1.put(k)
            yield env.timeout(PERIOD_MS)

    for process in (r1(), edge(), r2(), source()):
        env.process(process)
    env.run()
    return latency


def metrics(latency: NDArray[np.float64]) -> tuple[float, float]:
    """Mean over the windows of the 95th percentile, and of the share of missed deadlines."""
    windows = latency[: latency.size // WINDOW_CYCLES * WINDOW_CYCLES].reshape(-1, WINDOW_CYCLES)
    p95 = np.percentile(windows, 95, axis=1)
    return float(p95.mean()), float((windows > DEADLINE_MS).mean())


def main(cycles: int, variant: str) -> None:
    """Run one variant and print what it took and found."""
    variants: dict[str, Callable[[int], list[float]]] = {"process": run_process, "store": run_store}
    wall, cpu = time.perf_counter(), time.process_time()
    p95, miss = metrics(np.array(variants[variant](cycles)))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(json.dumps({"wall_s": wall, "cpu_s": cpu, "p95": p95, "miss": miss}))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
