"""Errors of trained networks against the length of their training, and of what data consistency
makes of their volumes.
"""

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch

from mvrecon.config import compose
from mvrecon.engine import checkpoints, fit
from mvrecon.metrics import nrmse
from mvrecon.reconstructors.cgls import cgls
from mvrecon.train import train

#: Training steps at which the error is looked at: three doublings.
STEPS = (50, 100, 200, 400)
#: Iterations of CGLS from a network's volume.
CONSISTENT = 300


class Training(NamedTuple):
    """One network of the experiment, trained from one seed.

    Args:
        method: label of the experiment.
        seed: of weights and training slices.
        variant: one of `VARIANTS`; none for the network as the experiment has it.
    """

    method: str
    seed: int
    variant: str = ""

    @property
    def label(self) -> str:
        """Name in the table."""
        return self.variant or self.method


#: Networks with one setting of the experiment changed: the loss, which is of volume and sinogram,
#: and the number of unrolled iterations, which is four.
VARIANTS = {
    "sinogram_unet, volume's loss": "loss.corrected_views=0",
    "sinogram_unet, sinogram's loss": "loss.volume=0",
    "itnet_2": "model.iterations=2",
    "itnet_8": "model.iterations=8",
}
SEEDS = (0, 1)
TRAININGS = (
    *(
        Training(method, seed)
        for seed in SEEDS
        for method in ("fbp_unet", "sinogram_unet", "dual_domain", "itnet_1", "itnet")
    ),
    *(
        Training("itnet" if "itnet" in variant else "sinogram_unet", seed, variant)
        for seed in SEEDS
        for variant in VARIANTS
    ),
    *(Training("primal_dual", seed) for seed in SEEDS),
)


def rows(training: Training, outputs: Path) -> Iterator[dict[str, Any]]:
    """A row for each number of steps: the mean error of unseen slices.

    The training goes on from its last checkpoint where it broke off.
    """
    changes = [VARIANTS[training.variant]] if training.variant else []
    settings = compose("experiment=sparse_view", f"seed={training.seed}", *changes)
    settings |= {"model": fit.methods(settings)[training.method], "compare": {}}
    folder = outputs / f"{plain(training.label)}_{training.seed}"
    table = train(settings, folder)
    (figures,) = table["methods"].values()
    with (folder / "metrics.csv").open(encoding="utf-8") as file:
        errors = {int(row["step"]) + 1: row for row in csv.DictReader(file) if row["val/nrmse"]}
    size, views = settings["grid"]["size"][0], settings["camera"]["n_views"]
    for steps in STEPS:
        yield {
            "method": training.label,
            "size": size,
            "views": views,
            "seed": training.seed,
            "counted": "steps",
            "count": steps,
            "nrmse": float(errors[steps]["val/nrmse"]),
            "view_nrmse": float(errors[steps]["val/view_nrmse"]),
            "seconds": figures["train_seconds"] * steps / STEPS[-1],
            "cases": settings["data"]["sizes"]["val"],
            "parameters": figures["parameters"],
            "nrmse_consistent": consistent(settings, folder) if steps == STEPS[-1] else "",
        }


def plain(label: str) -> str:
    """A label as a folder's name."""
    return re.sub(r"\W+", "_", label)


@torch.no_grad()
def consistent(settings: dict[str, Any], folder: Path) -> float:
    """Mean error after CGLS from the network's volumes: the nearest volumes that explain the views.

    What the network got wrong of what the views tell is gone; what is left, they do not tell.
    """
    (name,) = fit.methods(settings)
    module = checkpoints.load(checkpoints.finished(folder, name)).module.eval()
    data = fit.build_data(settings)
    data.setup("validate")
    cases = data.sets["val"].prepare()
    volume = module(cases["views"]).volume
    volume = cgls(module.projector, cases["views"], CONSISTENT, start=volume)
    errors = [nrmse(x, truth) for x, truth in zip(volume, cases["volume"], strict=True)]
    return sum(errors) / len(errors)
