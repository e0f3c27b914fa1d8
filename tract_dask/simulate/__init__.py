"""Images and movies with known truth: analytic columns, or multislice images where abTEM and ASE are installed."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
