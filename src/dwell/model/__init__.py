"""The frozen domain objects: pipeline, fabric, candidates, metrics and decisions."""

import lazy_loader

from dwell.model.evolve import evolve as evolve  # its module has the same name

# The names are in the stub; each is imported at its first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
