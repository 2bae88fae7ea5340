"""The same operator by other programs: each yields its name, its forward map and its adjoint."""

from collections.abc import Callable, Iterator

import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

Map = Callable[[torch.Tensor], torch.Tensor]
Operator = tuple[str, Map, Map]


def rtk(grid: Grid, rig: Cameras, threads: int) -> Iterator[Operator]:
    """RTK's Joseph filters, matched pair, on the CPU."""
    import itk
    from itk import RTK

    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads)
    image, pixel = itk.Image[itk.F, 3], rig.u.norm(dim=-1)[0].item()
    rows, columns = rig.shape
    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    centres = rig.origin + rig.u * (columns - 1) / 2 + rig.v * (rows - 1) / 2
    for source, centre, u, v in zip(rig.source, centres, rig.u / pixel, rig.v / pixel, strict=True):
        if not geometry.AddProjection(source.tolist(), centre.tolist(), u.tolist(), v.tolist()):
            raise ValueError("RTK does not take this geometry")

    on_grid = (list(grid.spacing), grid.affine[:3, 3].tolist())
    on_detector = ([pixel, pixel, 1.0], [-pixel * (columns - 1) / 2, -pixel * (rows - 1) / 2, 0.0])

    def picture(values: torch.Tensor, spacing: list[float], first: list[float]):
        made = itk.image_from_array(values.contiguous().numpy())
        made.SetSpacing(spacing)
        made.SetOrigin(first)
        return made

    def run(kind, target, given) -> torch.Tensor:
        operator = kind[image, image].New()
        operator.SetGeometry(geometry)
        operator.SetInput(0, target)
        operator.SetInput(1, given)
        operator.Update()
        return torch.from_numpy(itk.array_from_image(operator.GetOutput()))[None, None]

    def forward(x: torch.Tensor) -> torch.Tensor:
        empty = picture(torch.zeros(len(rig), rows, columns), *on_detector)
        return run(RTK.JosephForwardProjectionImageFilter, empty, picture(x[0, 0], *on_grid))

    def adjoint(y: torch.Tensor) -> torch.Tensor:
        empty = picture(torch.zeros(grid.shape), *on_grid)
        return run(RTK.JosephBackProjectionImageFilter, empty, picture(y[0, 0], *on_detector))

    yield "RTK joseph", forward, adjoint


def nanodrr(grid: Grid, rig: Cameras) -> Iterator[Operator]:
    """nanodrr's trilinear renderer, as many samples per ray as the volume has slabs; its adjoint by autograd."""
    from nanodrr.data import Subject
    from nanodrr.drr.renderer import render

    start, end = (p.float().flatten(1, 2) for p in rig.rays())
    affine, scale = grid.affine.float(), Subject._make_voxel_to_grid((1, 1, *grid.shape))
    frame, sdd = (torch.eye(3)[None], torch.eye(4)[None]), rig.distance.float()

    def forward(x: torch.Tensor) -> torch.Tensor:
        subject = Subject(x, torch.zeros_like(x), affine, affine.inverse(), scale, grid.centre.float(), 0)
        subject.convert_to_mu = False
        views = [
            render(subject, *frame, sdd[m : m + 1], *rig.shape, max(grid.shape), src=start[m, None], tgt=end[m, None])
            for m in range(len(rig))
        ]
        return torch.stack(views, dim=2)

    def adjoint(y: torch.Tensor) -> torch.Tensor:
        x = torch.zeros(1, 1, *grid.shape, requires_grad=True)
        return torch.autograd.grad(forward(x), x, y)[0]

    yield "nanodrr trilinear", forward, adjoint
