"""Measuring: samples of what tasks and links take on the computers at hand, for cells to replay.

`pinning` and `target` say on which cores and what; `measure` times a callable and `round_trips` a
connection; `profile_file` keeps the samples; `sample_statistics` describes and doubts them;
`cell_yaml` writes what a cell says to replay them. `speeds` says how fast the CPUs of a run were.
Nothing is imported here: a measurement begins with cores being chosen, and only then with the
packages that look how many there are.
"""
