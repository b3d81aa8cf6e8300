"""The topology of a cell: nodes, the links between them, and the tasks that may run on each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from dwell.display import write_number
from dwell.model import Problem, Trace
from dwell.model.bounds import counted
from dwell.report.charts import layer, quantity
from dwell.report.figure import Figure, Spec
from dwell.report.formatting import write_ms
from dwell.report.palette import INK, MUTED, PAPER, SHADE

if TYPE_CHECKING:
    from dwell.model import Link

#: Width of a node, and height of a line of text in it, pixels.
NODE_PX, LINE_PX = 150, 15
#: Order of the nodes on an ellipse, clockwise from the top.
TIERS = ("cloud", "edge", "robot")


def topology(problem: Problem) -> Figure:
    """Draw a cell's topology.

    A line shows the links of both directions, with the delay and rate of the link that the cell
    declares first. A node lists the tasks that it can run, anchored tasks in parentheses.
    """
    import polars as pl

    nodes = sorted(problem.fabric.nodes.values(), key=lambda node: TIERS.index(node.tier))
    step = 2 * math.pi / len(nodes)
    # Angles grow clockwise from the top, where the first node is.
    places = {
        node.name: (math.sin(i * step), math.cos(i * step)) if len(nodes) > 1 else (0.0, 0.0)
        for i, node in enumerate(nodes)
    }
    texts = {
        node.name: [
            f"{node.name}: {node.tier}, {counted(node.cores, 'core')}",
            *_tasks(problem, node.name),
        ]
        for node in nodes
    }
    boxes = [
        {"node": name, "x": x, "y": y, "line": line, "text": text, "head": line == 0}
        for name, (x, y) in places.items()
        for line, text in enumerate(texts[name])
    ]
    pairs: dict[frozenset[str], Link] = {}
    for link in problem.fabric.links.values():
        pairs.setdefault(frozenset((link.source, link.target)), link)
    lines = []
    for link in pairs.values():
        (x, y), (x2, y2) = places[link.source], places[link.target]
        ends = {"x": x, "y": y, "x2": x2, "y2": y2}
        lines.append({**ends, "mx": (x + x2) / 2, "my": (y + y2) / 2, "text": _link(link)})
    schema = dict.fromkeys(("x", "y", "x2", "y2", "mx", "my"), pl.Float64) | {"text": pl.String}
    frames = {"boxes": pl.DataFrame(boxes), "links": pl.DataFrame(lines, schema=schema)}
    most = max(map(len, texts.values()))
    tall = LINE_PX * most + 14
    height = tall if len(nodes) == 1 else max(2.6 * tall, 75 * len(nodes))
    low, high = min(y for _, y in places.values()), max(y for _, y in places.values())
    at = {
        "x": quantity("x", None, axis=None, scale={"domain": [-1.0, 1.0]}),
        "y": quantity("y", None, axis=None, scale={"domain": [low, high or 1.0]}),
    }
    middle = {"x": "mx", "y": "my", "text": "text"}
    halo: Spec = {"stroke": PAPER, "strokeWidth": 6, "strokeJoin": "round"}
    box: Spec = {"width": NODE_PX, "height": tall, "fill": SHADE, "stroke": MUTED}
    first = -(tall - LINE_PX) / 2 + 7
    layers = [
        layer("rule", {"x2": "x2", "y2": "y2"}, rows="links", color=MUTED, strokeWidth=1.2),
        layer("text", middle, rows="links", color=MUTED, **halo),
        layer("text", middle, rows="links", color=MUTED, stroke=None),
        layer("rect", {}, rows="boxes", where=["datum.head"], cornerRadius=4, **box),
    ]
    layers += [
        layer(
            "text",
            {"text": "text"},
            rows="boxes",
            where=[f"datum.line == {line}"],
            dy=first + line * LINE_PX,
            color=MUTED if line else INK,
            fontWeight="normal" if line else 600,
        )
        for line in range(most)
    ]

    def draw(width: float) -> Spec:
        return {
            "width": min(width, 620.0) - NODE_PX,
            "height": height - tall,
            "padding": {"left": NODE_PX / 2, "right": NODE_PX / 2, "top": tall, "bottom": tall},
            "encoding": at,
            "layer": layers,
        }

    return Figure("topology", f"Topology of {problem.name}", frames, draw)


def _tasks(problem: Problem, node: str) -> list[str]:
    """Return the names of the tasks that a node can run, anchored tasks in parentheses."""
    tasks = problem.pipeline.tasks.values()
    return [f"({one.name})" if one.anchored else one.name for one in tasks if node in one.on]


def _link(link: Link) -> str:
    replayed = isinstance(link.delay_ms, Trace)
    delay = "as recorded" if replayed else write_ms(link.delay_ms.expectation)
    rate = "" if math.isinf(link.rate_mbps) else f", {write_number(link.rate_mbps, 0)} Mbit/s"
    return f"{delay}{rate}"
