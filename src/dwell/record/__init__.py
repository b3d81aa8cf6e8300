"""Records of runs: schema and tables, files of finished runs, and journals of live runs."""

import lazy_loader

from dwell.record.moves import moves as moves  # its module has the same name

# The names are in the stub; each is imported at its first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
