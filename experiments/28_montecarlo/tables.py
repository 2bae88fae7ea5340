"""Held-out log-likelihoods, contrasts of rods, and a picture, from reconstructions.

python experiments/28_montecarlo/tables.py RUN_FOLDER OUT_FOLDER
"""

import sys
from pathlib import Path

import torch
from derenzo import contrasts
from matplotlib import pyplot

from mvrecon.core.files.runs import write_rows

#: Panels of the picture: version, method, operator.
PANELS = [
    ("8c87dee2", "osem", "plain"),
    ("8c87dee2", "osem", "hole"),
    ("8c87dee2", "osem", "hole, 50^2 pixels summed"),
    ("8c87dee2", "osem", "hole, 100^2 pixels summed"),
    ("", "osem", "plain"),
    ("", "osem", "hole"),
    ("", "osem", "hole, intrinsic 1.5 mm"),
    ("", "osem", "hole, crystal"),
    ("", "osem", "hole, crystal, intrinsic 1.5 mm"),
    ("", "bsrem", "plain"),
    ("", "bsrem", "hole"),
    ("", "bsrem", "hole, crystal"),
]


def draw(volumes: dict[tuple, torch.Tensor], file: Path) -> None:
    """Sums along the rods, all in one scale."""
    flat = {key: volumes[key].sum(dim=0) * 1.5 for key in PANELS if key in volumes}
    top = torch.stack(list(flat.values())).quantile(0.996).item()
    figure, axes = pyplot.subplots(3, 4, figsize=(8, 6.6), layout="constrained")
    for axis in axes.flat:
        axis.axis("off")
    places = dict(zip(PANELS, axes.flat, strict=True))
    for key, image in flat.items():
        version, method, operator = key
        named = method.upper() + " before footprints" * (version != "")
        shown = places[key].imshow(image, cmap="inferno", vmin=0, vmax=top, origin="lower")
        places[key].set_title(f"{named}\n{operator}", fontsize=7)
    figure.colorbar(shown, ax=axes, label="counts / mm$^2$, summed along the rods", fraction=0.03)
    figure.savefig(file, dpi=100)


def main(runs: Path, out: Path) -> None:
    """Each run at the iteration of the greatest mean over seeds."""
    likelihoods, sectors, volumes = [], [], {}
    for file in sorted(runs.glob("*, *.pt")):
        run = torch.load(file)
        names, values = run["names"], run["likelihood"]
        best = int(values.mean(dim=1).argmax())
        for seed, own in enumerate(values.unbind(dim=1)):
            row = {"seed": seed, "iteration": int(own.argmax()) + 1}
            likelihoods.append(names | row | {"held_out": f"{own.max().item():.1f}"})
        values = {k: f"{v:.2f}" for k, v in contrasts(run["volumes"][best]).items()}
        sectors.append(names | {"iteration": best + 1} | values)
        volumes[tuple(names.values())] = run["volumes"][best]
    write_rows(out / "held_out.csv", likelihoods)
    write_rows(out / "contrast.csv", sectors)
    draw(volumes, out / "derenzo.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
