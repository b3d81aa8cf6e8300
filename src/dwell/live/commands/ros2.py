"""`dwell ros2`: the state of a live cell for ROS 2; unknown types of topics for `dwell check`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Annotated

import typer

from dwell.cli.options import CellArgument, Insecure, Keys, flag, option
from dwell.errors import Fault, LiveError, not_installed
from dwell.model import Problem

#: Seconds between two messages.
EVERY_S = 1.0

ros2 = typer.Typer(no_args_is_help=True, help="Show the state of a live cell to ROS 2.")


@ros2.callback()
def _group() -> None:
    """Show the state of a live cell to ROS 2."""


@ros2.command()
def diagnostics(
    cell: CellArgument,
    connect: Annotated[
        str | None, option("ENDPOINT", "Zenoh router.", default="tcp/localhost:7447")
    ] = None,
    domain: Annotated[int | None, option("N", "ROS domain.", default="ROS_DOMAIN_ID, or 0")] = None,
    once: Annotated[bool, flag("--once", "Publish one message, and end.")] = False,
    keys: Keys = None,
    insecure: Insecure = False,
) -> None:
    """Publish the state of a cell on /diagnostics, once per second."""
    import dwell
    from dwell.live.host.operator_client import OperatorClient
    from dwell.live.host.security import environment
    from dwell.live.ros2.diagnostics import TOPIC, TYPE
    from dwell.live.ros2.diagnostics import diagnostics as fields_of
    from dwell.live.ros2.topic_sink import Sink
    from dwell.live.stage import Message, StagePlace

    problem = dwell.load(cell)
    sink = Sink(TOPIC, TYPE, connect=connect, domain=domain, require_subscriber=once)
    sink.placed(StagePlace(problem.name, "diagnostics"))
    sink.start()
    try:
        with OperatorClient(problem, environment(keys, insecure=insecure)) as visitor:
            trouble = ""
            for status in visitor.watch(EVERY_S):
                try:
                    sink.apply(Message(fields_of(problem, status, time.time_ns())))
                except LiveError as error:
                    if str(error) != trouble:
                        typer.echo(f"warning: {error}", err=True)
                    trouble = str(error)
                else:
                    trouble = ""
                    if once:
                        return
    finally:
        sink.stop()


def unknown_types(problem: Problem) -> Iterator[Fault]:
    """Yield the topics whose types are unknown; none if a package is missing here."""
    if not_installed("live", "ros2"):
        return
    from dwell.live.host.stage_modules import ros_topics

    for path, topic in ros_topics(problem, problem.fabric.nodes).items():
        from dwell.live.ros2.message_types import types_of

        try:
            types_of(topic, problem.folder)
        except LiveError as error:
            yield Fault(f"{path}.type", str(error))
