"""Measuring: samples of what tasks and links take on the computers at hand, for cells to replay.

`pinning` chooses the cores and `target` the callable; `measure` times a callable and `round_trips`
a connection; `profile_file` keeps the samples; `sample_statistics` describes and doubts them;
`cell_yaml` writes the part of a cell that replays them; `speeds` compares the speeds of a run's
CPUs. Nothing is imported here: a measurement begins with cores being chosen, and only then with the
packages that look how many there are.
"""
