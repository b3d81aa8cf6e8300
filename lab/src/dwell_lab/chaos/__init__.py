"""Chaos: what befalls a live cell on purpose, and who watches whether it keeps its promises.

The watchers are no part of the cell: a process that listens on the wire (`wiretap`), and
the log of the actuator (`actuations`).
"""
