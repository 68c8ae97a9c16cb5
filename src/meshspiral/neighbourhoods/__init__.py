"""What a network sees around a vertex: one class a file, registered by name.

Importing the package registers every class of this folder.
"""

import importlib
import pkgutil

from meshspiral.neighbourhoods.base import Neighbourhood

__all__ = ["Neighbourhood"]

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
