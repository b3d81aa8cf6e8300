"""A live cell on this computer: its processes, emulated links, and disturbances."""
