"""A term of the loss that sees the heart: the mean squared error within 55 mm of where
`dcspect_cardiac` has it.

PYTHONPATH=experiments/20_dcspect mvrecon-train experiment=dcspect_cardiac plugins=[heart] \
    loss.common_field=0 +loss.heart=1 hydra.run.dir=outputs/20_dcspect/cardiac_heart
"""

from torch import Tensor

from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.models.output import Reconstruction
from mvrecon.parts import LOSSES

#: In mm from the world's origin.
NEAR = 55.0
#: That of the experiment.
GRID = Grid.centred(size=(40, 32, 32), spacing=8.0, centre=(40, -40, 0))
HEART = voxel_centres(GRID).norm(dim=-1) < NEAR


@LOSSES.register("heart")
def heart(out: Reconstruction, batch: dict[str, Tensor], data_range: float) -> Tensor:
    """Mean squared error of the voxels about the heart, relative to the value range."""
    error = (out.volume - batch["volume"]) / data_range
    return error[..., HEART.to(error.device)].square().mean()
