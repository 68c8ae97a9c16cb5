"""Descriptors: what a network reads at each vertex. One class a file, registered by name.

Importing the package registers every class of this folder.
"""

import importlib
import pkgutil

from meshspiral.data.descriptors.base import Descriptor, Features, settings_with_descriptors

__all__ = ["Descriptor", "Features", "settings_with_descriptors"]

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
