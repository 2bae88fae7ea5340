"""What every projector is: a linear operator between volumes and views of one grid and one rig."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
