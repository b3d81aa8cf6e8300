"""Reports: pages, text for the terminal, files for papers."""

import lazy_loader

# A name is imported when it is used; the stub lists them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
