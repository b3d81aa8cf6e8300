"""Testbed: a live cell on this computer, with emulated links and disturbances."""
