"""Due tasks: which tasks run in a cycle, and which messages they wait for."""

from __future__ import annotations

from dwell.model.pipeline import Flow, Pipeline


class DueTasks:
    """The tasks of a pipeline that run in each cycle, by their rates.

    docs/background/simulator.md defines rates, under "Several rates".

    Attributes
    ----------
    rates : dict of str to int
        Cycles from one run of each task to its next.
    sources : tuple of str
        Tasks without waited inputs, which begin at a cycle's release.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.rates = pipeline.rates
        self.sources = tuple(name for name in pipeline.tasks if not pipeline.waited(name))
        self._sink_rates = pipeline.sink_rates
        self._pipeline = pipeline
        self._intervals = sorted({*self.rates.values()} - {1})
        self._sinks: dict[tuple[bool, ...], frozenset[str]] = {}

    def runs(self, task: str, cycle: int) -> bool:
        """Whether a task is due in a cycle."""
        return cycle % self.rates[task] == 0

    def pattern(self, cycle: int) -> tuple[bool, ...]:
        """Return whether each rate above 1 is due in a cycle, which determines the due tasks."""
        return tuple(cycle % rate == 0 for rate in self._intervals)

    def sends(self, flow: Flow, cycle: int) -> bool:
        """Whether a flow has a message in a cycle: a waited flow needs a target that is due."""
        return self.runs(flow.source if flow.sampled else flow.target, cycle)

    def sinks(self, cycle: int) -> frozenset[str]:
        """Return the tasks without outputs that are due in a cycle; none in an idle cycle."""
        due = self.pattern(cycle)
        if due not in self._sinks:
            names = (name for name in self._pipeline.sinks if self.runs(name, cycle))
            self._sinks[due] = frozenset(names)
        return self._sinks[due]

    def is_needed(self, task: str, cycle: int) -> bool:
        """Whether waited flows lead from a task to a sink that is due, or it is such a sink."""
        return any(cycle % rate == 0 for rate in self._sink_rates[task])

    def shadow_ends(self, apart: frozenset[str], cycle: int) -> frozenset[str]:
        """Return the tasks at which the shadow of a cycle ends.

        These are the sinks that are due and do not belong to the cycle itself, and the targets that
        sample an output of its jobs. `apart` are the tasks that the shadow does not share with the
        cycle (see `Pipeline.diverging`).
        """
        sampled = (flow for flow in self._pipeline.flows if flow.sampled and flow.source in apart)
        ends = {flow.target for flow in sampled if self.runs(flow.source, cycle)}
        return (self.sinks(cycle) & apart) | ends
