"""Policies: observation and estimates in, the decision for the next window out."""

import lazy_loader

# Importing the package loads no policy: a name is imported at its first use. The stub lists them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
