"""Memory that a training's step needs, estimated before the first one on a coarse copy of its grid
and rig.
"""

import math

import torch
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.engine.module import ReconstructionModule
from mvrecon.files.memory import memory_at_hand
from mvrecon.geometry.grid import Grid
from mvrecon.parts import MODELS, PROJECTORS

#: Voxels along the shortest edge of the coarse grid, at least.
EDGE = 16
#: Voxels in a batch up to which nothing is estimated: they fit anywhere.
SMALL = 2**17
#: Bytes of a weight in training: itself, its gradient, and two moments of Adam.
WEIGHT = 16
#: The part of an estimate that must be at hand: it counts what is kept for the gradient, as on a
#: fine grid, to about a fifth.
SURE = 0.75


def check_training(module: ReconstructionModule, batch_size: int, accelerator: str) -> int | None:
    """Check that a step of training fits into memory; returns its bytes, None where it is small.

    Args:
        module: in training.
        batch_size: cases in a step.
        accelerator: Lightning's name of the device that it runs on.

    Raises:
        ValueError: it cannot fit; the message says both numbers, and what would fit.
    """
    if batch_size * math.prod(module.projector.grid.shape) <= SMALL:
        return None
    needed = step_bytes(module, batch_size)
    on_gpu = accelerator != "cpu" and torch.cuda.is_available()
    room = torch.cuda.mem_get_info()[0] if on_gpu else memory_at_hand()
    if room is not None and SURE * needed > room:
        raise ValueError(
            f"A step of {module.hparams['model']['name']} needs about {needed / 2**30:,.1f} GiB of "
            f"memory; {room / 2**30:,.1f} GiB are at hand: take a smaller data.batch_size (now "
            f"{batch_size}), fewer channels or a coarser grid"
        )
    return needed


def step_bytes(module: ReconstructionModule, batch_size: int, edge: int = EDGE) -> int:
    """Bytes that a step of training keeps, about: weights, and what the model keeps for its
    gradient, which grows with the number of voxels.

    Args:
        module: in training.
        batch_size: cases in a step.
        edge: voxels along the shortest edge of the grid that it is measured on.
    """
    A, settings = module.projector, module.hparams
    factor = max(1, min(A.grid.shape) // edge)
    coarse = PROJECTORS.from_config(
        settings["geometry"]["projector"],
        grid=_coarse_grid(A.grid, factor),
        cameras=_coarse_rig(A.cameras, factor),
    )
    with torch.random.fork_rng(devices=[]):
        model = MODELS.from_config(settings["model"], projector=coarse).train()
        views = coarse(torch.ones(1, 1, *coarse.domain_shape))
        kept = _kept(model, views)
    weights = sum(p.numel() for p in module.model.parameters())
    return WEIGHT * weights + batch_size * factor**3 * kept


def _kept(model: torch.nn.Module, views: Tensor) -> int:
    """Bytes that a model keeps for the gradient of one case, besides its weights."""
    weights = {tensor.untyped_storage().data_ptr() for tensor in model.state_dict().values()}
    sizes: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            sizes[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        out = model(views)  # alive until all are counted, so that no place is used twice
        kept = sum(sizes.values())
    del out
    return kept


def _coarse_grid(grid: Grid, factor: int) -> Grid:
    """The same field in voxels that are `factor` times as wide."""
    size = [max(1, n // factor) for n in grid.shape[::-1]]
    spacing = [factor * step for step in grid.spacing]
    return Grid.centred(size=size, spacing=spacing, centre=grid.centre.tolist())


def _coarse_rig(cameras: Cameras, factor: int) -> Cameras:
    """The same rig with `factor` x `factor` pixels in one, those that are left over cut off."""
    f = min(factor, *cameras.shape)
    rows, columns = (n // f * f for n in cameras.shape)
    return cameras.cropped((0, rows), (0, columns)).binned(f)
