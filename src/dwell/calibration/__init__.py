"""Measurement of tasks and links on real computers, as samples that cells replay.

`pinning` chooses the cores and `target` the callable; `measure` times a callable and `round_trips`
a connection; `profile_file` stores the samples; `sample_statistics` describes them and reports
doubts; `cell_yaml` writes the part of a cell that replays them. This package imports nothing: a
measurement chooses its cores first, and then imports packages that count the cores.
"""
