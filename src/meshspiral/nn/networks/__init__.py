"""Networks: one class a file, registered by name.

Importing the package registers every class of this folder.
"""

import importlib
import pkgutil

from meshspiral.nn.networks.acnn import ACNN
from meshspiral.nn.networks.base import Network
from meshspiral.nn.networks.conv import ConvNet
from meshspiral.nn.networks.diffusion import DiffusionNet
from meshspiral.nn.networks.fcs import FCSNet
from meshspiral.nn.networks.gcnn3 import GCNN3
from meshspiral.nn.networks.lstm import LSTMNet
from meshspiral.nn.networks.monet import MoNet
from meshspiral.nn.networks.spiral_net import SpiralNet

__all__ = [
    "ACNN",
    "GCNN3",
    "ConvNet",
    "DiffusionNet",
    "FCSNet",
    "LSTMNet",
    "MoNet",
    "Network",
    "SpiralNet",
]

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")
