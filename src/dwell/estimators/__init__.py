"""Estimators: the QoS that every candidate would show, active or not."""

import lazy_loader

# What is asked for is imported, and nothing else; the names are in the stub.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
