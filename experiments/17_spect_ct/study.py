"""SPECT/CT: cone-beam views of a stationary inner rig, to attenuation, to 140.5 keV, to OSEM.

python experiments/17_spect_ct/study.py OUT_FOLDER
"""

import sys
from pathlib import Path

import torch
from matplotlib import pyplot

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.attenuation import attenuation, hounsfield, tissue_at
from mvrecon.data.resample import resample
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.grid import voxel_centres
from mvrecon_spect.metrics.contrast import count_bias
from mvrecon_spect.operators.projector import Spect
from mvrecon_spect.scenes.ventricle import ventricle

GRID = mv.Grid.centred(48, spacing=5.0)
CT_KEV, SPECT_KEV = 70.0, 140.5
PHOTONS, COUNTS, DRAWS = 1e4, 2e6, 3
SHIFT = (10.0, 0.0, 0.0)  # mm
BODY, LUNG = (112.0, 88.0, 100.0), 0.26
HEART = {"semi_axes": (35.0, 35.0, 45.0), "wall": 12.0, "euler_degrees": (40.0, 60.0, 0.0)}
#: Kind, centre and half lengths in mm, and how much of water or bone each part adds.
TORSO = (
    ("cylinder", (0.0, -20.0, 0.0), BODY, 1.0, 0.0),
    ("ellipsoid", (70.0, -15.0, 0.0), (30.0, 45.0, 80.0), LUNG - 1, 0.0),
    ("ellipsoid", (-70.0, -20.0, 0.0), (28.0, 45.0, 80.0), LUNG - 1, 0.0),
    ("cylinder", (0.0, -85.0, 0.0), (16.0, 16.0, 100.0), -1.0, 1.0),
)


def torso(kev: float) -> Phantom:
    """Attenuation of a chest with lungs and spine in 1/mm, at an energy in keV."""
    tissue, parts = tissue_at(kev), []
    for kind, centre, half, water, bone in TORSO:
        place, value = torch.tensor([[centre], [half]]), water * tissue.water + bone * tissue.bone
        parts.append(Solids.upright(kind, *place, torch.tensor([value])))
    return Phantom(tuple(parts))


def activity() -> Phantom:
    """A ventricle of activity 8 about blood of 1, in a ball of 1, in the field of all pinholes."""
    size = torch.full((1, 3), 70.0)
    ball = Solids.upright("ellipsoid", torch.zeros(1, 3), size, torch.ones(1))
    return Phantom((ball, *ventricle(value=7.0, **HEART).parts))


def transmission() -> torch.Tensor:
    """Attenuation at 140.5 keV on GRID from 40 noisy cone-beam views of a fixed inner ring."""
    ring = mv.circular(
        n_views=40, sid=300.0, sdd=500.0, detector={"pixels": [72, 72], "pixel_mm": 9.0}
    )
    integrals = torso(CT_KEV).views(ring).float()
    noise = torch.Generator().manual_seed(0)
    photons = torch.poisson(PHOTONS * torch.exp(-integrals), generator=noise).clamp(min=1)
    views = -torch.log(photons / PHOTONS)[None, None]
    at_70 = mv.sirt(mv.Drr(GRID, ring), views, iterations=30, momentum=True)[0, 0]
    return attenuation(hounsfield(at_70, CT_KEV), SPECT_KEV).clamp(max=tissue_at(SPECT_KEV).bone)


def shifted(mu: torch.Tensor) -> torch.Tensor:
    """The same attenuation after the patient moved."""
    moved = mv.Grid(GRID.shape, GRID.affine.clone())
    moved.affine[:3, 3] += torch.tensor(SHIFT, dtype=torch.float64)
    return resample(mu, moved, GRID)


def wall() -> tuple[torch.Tensor, torch.Tensor]:
    """Voxels of the ventricle's wall, those nearer to the mean pinhole and the others."""
    share = voxelise(ventricle(**HEART), GRID)
    mean = mv.dcspect80(pixels=4).source.mean(dim=0)
    near = (voxel_centres(GRID) @ mean) > 0
    return (share > 0.5) & near, (share > 0.5) & ~near


def measure(out: Path) -> None:
    """A row for each attenuation and draw of noise; the table is written after each draw."""
    cameras, fine = mv.dcspect80(pixels=32), GRID.refined(2)
    true_fine = voxelise(torso(SPECT_KEV), fine)
    A = Spect(fine, cameras, mu=true_fine)
    ideal = A(voxelise(activity(), fine)[None, None])
    truth, true = voxelise(activity(), GRID), voxelise(torso(SPECT_KEV), GRID)
    estimated = transmission()
    maps = {
        "none": None,
        "true": true,
        "estimated": estimated,
        "estimated, 10 mm shifted": shifted(estimated),
    }
    near, far = wall()
    inside = voxel_centres(GRID).norm(dim=-1) < 70
    scale, rows, volumes = COUNTS / ideal.sum().item(), [], {}
    for draw in range(DRAWS):
        noise = torch.Generator().manual_seed(draw)
        counts = torch.poisson(scale * ideal, generator=noise)
        for name, mu in maps.items():
            operator = Spect(GRID, cameras, mu=mu)
            x = mv.osem(operator, counts, 4, 20)[0, 0] / scale
            volumes.setdefault(name, x)
            error = ((x - truth)[inside].norm() / truth[inside].norm()).item()
            sides = (x[near].mean() / truth[near].mean()) / (x[far].mean() / truth[far].mean())
            off = 0.0 if mu is None else (mu - true).norm().item() / true.norm().item()
            rows.append(
                {
                    "mu": name,
                    "draw": draw,
                    "mu_nrmse": "" if mu is None else f"{off:.3f}",
                    "wall_bias": f"{count_bias(x, truth, near | far):.4f}",
                    "near_over_far": f"{sides.item():.4f}",
                    "nrmse": f"{error:.4f}",
                }
            )
        write_rows(out / "results.csv", rows)
        if draw == 0:
            known = {f"mu: {name}": x for name, x in volumes.items()}
            draw_planes(out / "planes.png", {"truth": truth, **known}, true, estimated)


def draw_planes(file: Path, volumes: dict, true: torch.Tensor, estimated: torch.Tensor) -> None:
    """Middle planes of the activities, and of both attenuations."""
    figure = pyplot.figure(figsize=(8, 4.8), layout="constrained")
    above, below = figure.subfigures(2, 1)
    edge = GRID.size[0] * GRID.spacing[0] / 2
    rows = (
        (above, volumes, 10.0, "inferno", "activity, blood is 1"),
        (below, {"true mu": true, "estimated mu": estimated}, 0.03, "gray", "mu / (1/mm)"),
    )
    for part, images, top, cmap, unit in rows:
        axes = part.subplots(1, len(images), sharey=True)
        for axis, (name, x) in zip(axes, images.items(), strict=True):
            shown = axis.imshow(
                x[24], cmap=cmap, vmin=0, vmax=top, origin="lower", extent=2 * (-edge, edge)
            )
            axis.set_title(name.replace(", ", ",\n"), fontsize=10)
            axis.set_xlabel("x / mm")
        axes[0].set_ylabel("y / mm")
        part.colorbar(shown, ax=axes, label=unit)
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    measure(folder)
