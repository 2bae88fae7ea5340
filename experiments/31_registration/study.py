"""Rigid registration of a known volume to one or two X-ray views, from 50 random starts.

python experiments/31_registration/study.py OUT.csv [--starts 50] [--only PART]

Starts that OUT.csv has are skipped.
"""

import argparse
import csv
import time
from pathlib import Path

import torch
from nanodrr.data import Subject
from nanodrr.metrics import NormalizedCrossCorrelation2d
from nanodrr.registration import Registration
from torch import Tensor
from torch.nn.functional import avg_pool2d

import mvrecon as mv
from mvrecon_peers.nanodrr import Nanodrr

GRID = mv.Grid.centred(64, spacing=2.0)
PIXELS, PITCH, SID, SDD = 96, 2.5, 600.0, 900.0
#: Ranges of the true motion: degrees about the axes of the rotation vector, mm.
MOST = torch.tensor([15.0, 15.0, 15.0, 20.0, 20.0, 20.0], dtype=torch.float64)


def c_arm(views: int) -> mv.Cameras:
    """One view, or two that are 90 degrees apart."""
    detector = {"pixels": [PIXELS, PIXELS], "pixel_mm": PITCH}
    return mv.circular(views, SID, SDD, detector, arc_degrees=90.0 * views)


def motion(pose: Tensor) -> tuple[Tensor, Tensor]:
    """R [3 3] and t [3] in mm of a rotation vector in degrees and t."""
    x, y, z = pose[:3].deg2rad()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return torch.linalg.matrix_exp(skew), pose[3:]


def correlation(one: Tensor, other: Tensor) -> Tensor:
    """Normalised cross-correlation of views [m v u], the mean over the views."""
    one, other = (y - y.mean((-2, -1), keepdim=True) for y in (one, other))
    norms = one.norm(dim=(-2, -1)) * other.norm(dim=(-2, -1))
    return ((one * other).sum((-2, -1)) / norms).mean()


def descent(projector: type, rig: mv.Cameras, ct: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
    """The tutorial's registration: Adam from coarse to fine pixels, 120 projections."""
    pose = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    for pixels in (4, 2, 1):
        adam = torch.optim.Adam([pose], lr=pixels / 2)  # degrees, mm
        target = avg_pool2d(views, pixels)
        for _ in range(40):
            projected = projector(GRID, rig.moved(*motion(pose)))(ct)[0, 0]
            loss = 1 - correlation(avg_pool2d(projected, pixels), target)
            adam.zero_grad()
            loss.backward()
            adam.step()
    return motion(pose.detach())


def nanodrr_tutorial(rig: mv.Cameras, ct: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
    """nanodrr's module with the settings of its tutorial, of one view: 500 samples on a ray, 0.05
    radians and 10 mm as learning rates, at most 500 iterations, until the correlation is 0.999.
    """
    affine = GRID.affine.float()
    counts = torch.tensor(GRID.size).float()
    to_grid = torch.diag(torch.cat([2 / counts, torch.ones(1)]))
    to_grid[:3, 3] = 1 / counts - 1
    centre = torch.zeros(3)
    subject = Subject(ct, torch.zeros_like(ct), affine, affine.inverse(), to_grid, centre, 0)
    subject.convert_to_mu = False
    # nanodrr's camera looks along z of its frame, with pixels (u, v) along its x and y
    u, v = (torch.nn.functional.normalize(step, dim=-1) for step in (rig.u[0], rig.v[0]))
    start = torch.eye(4, dtype=torch.float64)
    start[:3, :3] = torch.stack([u, v, torch.linalg.cross(u, v)], dim=1)
    start[:3, 3] = rig.source[0]
    centre_pixel = (PIXELS - 1) / 2 + 0.5  # nanodrr counts from the pixels' corners
    focal = SDD / PITCH
    intrinsic = torch.tensor([[focal, 0, centre_pixel], [0, focal, centre_pixel], [0, 0, 1]])
    module = Registration(
        subject,
        start.float()[None],
        intrinsic.inverse()[None],
        torch.tensor([SDD]),
        PIXELS,
        PIXELS,
    )
    rates = [{"params": [module._rot], "lr": 5e-2}, {"params": [module._xyz], "lr": 10.0}]
    adam, similarity = torch.optim.Adam(rates, maximize=True), NormalizedCrossCorrelation2d()
    for _ in range(500):
        adam.zero_grad()
        value = similarity(views[None], module())
        value.backward()
        adam.step()
        if value.item() > 0.999:
            break
    moved = module.pose[0].detach().double() @ start.inverse()
    return moved[:3, :3], moved[:3, 3]


#: Name of a part, number of views and its registration(rig, ct, views).
PARTS = {
    "mvrecon": lambda rig, ct, views: descent(mv.Drr, rig, ct, views),
    "nanodrr, same descent": lambda rig, ct, views: descent(Nanodrr, rig, ct, views),
    "nanodrr, its tutorial": nanodrr_tutorial,
}


def main() -> None:
    """All parts from each start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--starts", type=int, default=50)
    parser.add_argument("--only", choices=PARTS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    done = set()
    if given.out.exists():
        with given.out.open() as file:
            done = {(row["part"], row["views"], row["start"]) for row in csv.DictReader(file)}
    generator = torch.Generator().manual_seed(0)
    for start in range(given.starts):
        true = motion((2 * torch.rand(6, generator=generator, dtype=torch.float64) - 1) * MOST)
        for views in (1, 2):
            rig = c_arm(views)
            scene = mv.phantom("ellipsoids", GRID, rig.moved(*true), case=3, value=0.02)
            for part, register in PARTS.items():
                if (part, str(views), str(start)) in done or given.only not in (None, part):
                    continue
                if part == "nanodrr, its tutorial" and views == 2:
                    continue  # its module turns each camera about its own axes
                began = time.process_time()
                R, t = register(rig, scene.volume[None], scene.views[0])
                seconds = time.process_time() - began
                turn = ((torch.trace(R.mT @ true[0]) - 1) / 2).clamp(-1, 1).acos().rad2deg()
                shift = (R.mT @ t - true[0].mT @ true[1]).norm()
                row = {"part": part, "views": views, "start": start}
                row |= {"degrees": f"{turn:.4f}", "mm": f"{shift:.4f}", "seconds": f"{seconds:.2f}"}
                new = not given.out.exists()
                with given.out.open("a", newline="") as file:
                    writer = csv.DictWriter(file, row)
                    if new:
                        writer.writeheader()
                    writer.writerow(row)


if __name__ == "__main__":
    main()
