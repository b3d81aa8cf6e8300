"""Chaos: faults injected into a live cell, and checks that the cell keeps its promises.

The checks are independent of the cell. They use a process that records the messages on the wire
(`wiretap`), and the log of the actuator (`actuations`).
"""
