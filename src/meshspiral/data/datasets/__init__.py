"""Data sets: one class a file, registered by name.

Importing the package registers every class of this folder.
"""

import importlib
import pkgutil

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
