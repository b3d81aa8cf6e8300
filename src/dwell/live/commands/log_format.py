"""Option `--log-format` of agents, controllers and the web page."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from dwell.cli.options import option


class LogFormat(StrEnum):
    """Forms of the log on stderr."""

    TEXT = "text"
    JSON = "json"


Logs = Annotated[
    LogFormat,
    option("text|json", "Format of the log on stderr.", "--log-format"),
]


def begin_log(log_format: LogFormat, who: str) -> None:
    """Set the form of this process's log."""
    if log_format is LogFormat.JSON:
        from dwell.live.log import log_as_json

        log_as_json(who)
