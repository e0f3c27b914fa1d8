"""What every page of the project is drawn with: charts, images, the map of columns, numbers as text, colours.

``static`` holds plain modules and style sheets for browsers, without a build step and without a dependency: the service
serves them beside its own, under one address; the report has them inside, see :func:`bundle`.
"""

from .bundle import STATIC, bundle

__all__ = ["STATIC", "bundle"]
