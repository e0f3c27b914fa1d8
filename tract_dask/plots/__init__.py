"""Figures: one function each, Dataset in, matplotlib Figure out, with ``path`` to save it as well.

They are drawn without pyplot, so they leave its state alone and may be made in any thread. Positions are px of the
summed image, x to the right and y down. Matplotlib is imported with the first of them that is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
