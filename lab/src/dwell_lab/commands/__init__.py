"""The commands `dwell testbed` and `dwell validate`."""
