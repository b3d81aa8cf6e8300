"""Samples of a scenario's random quantities, and the compiled event loop that simulates it."""
