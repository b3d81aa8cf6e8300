"""Estimators: they predict the QoS of every candidate, active or not."""

import lazy_loader

# The names are in the stub; each is imported at its first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
