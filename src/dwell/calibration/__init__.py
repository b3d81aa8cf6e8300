"""Measuring: samples of what tasks and links take on the computers at hand, for cells to replay.

`pinning` and `target` say on which cores and what; `measure` times a callable and `link` a
connection; `profile_file` keeps the samples; `summary` describes and doubts them; `cell_yaml`
writes what a cell says to replay them. Nothing is imported here: a measurement begins with cores
being chosen, and only then with the packages that look how many there are.
"""
