"""Do methods keep a defect of the left ventricle: contrast in it and in the same place of healthy
hearts, area under the ROC curve of that contrast, bias of the wall's counts.

python experiments/20_dcspect/defects.py [--name cardiac_heart] [--cases 64]  # defects.csv
"""

import argparse
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from heart import NEAR  # and the term of the loss that runs may have
from mvrecon.engine.on_case import reconstructed
from torchmetrics.functional.classification import binary_auroc

from mvrecon.data.module import TEST, SceneData
from mvrecon.engine.evaluation import load_methods
from mvrecon.engine.fit import build_data
from mvrecon.engine.run_folder import read_settings
from mvrecon.files.tables import renewed, write_rows
from mvrecon.geometry.grid import voxel_centres
from mvrecon_spect.metrics.contrast import count_bias, defect_contrast

TABLE = Path(__file__).parent / "defects.csv"
#: Voxels of the left ventricle's wall are so full of it.
FULL = 0.65
#: Share of the loss that voxels of a defect have, and those of the wall beside it at most.
MOST, NONE = 0.6, 0.05
#: Contrast of the defect that says where it is, or would be.
MARKED = 0.6
#: Voxels that a region must have.
LEAST = 4


class Regions(NamedTuple):
    """Of one patient: voxels of the wall, and of the defect that it has, or would have."""

    wall: torch.Tensor
    defect: torch.Tensor


def truth_of(scene: object, index: int, data: SceneData) -> torch.Tensor:
    """The activity of a test case."""
    fine = scene.finer(index, TEST, data.grid, data.cameras, 2)
    return scene.pooled(index, TEST, data.grid, fine).volume[0]


def regions_of(index: int, data: SceneData) -> Regions | None:
    """The regions of a test case; none where its defect would be too small for these voxels."""
    scene = data.scenes["test"]
    marked = {"defects": 1.0, "contrast": (MARKED, MARKED)}
    healthy = truth_of(replace(scene, contrast=(0.0, 0.0)), index, data)
    lost = (healthy - truth_of(replace(scene, **marked), index, data)) / MARKED
    wall = (healthy > FULL) & (voxel_centres(data.grid).norm(dim=-1) < NEAR)
    regions = Regions(wall & (lost < NONE), wall & (lost > MOST))
    return regions if min(int(mask.sum()) for mask in regions) >= LEAST else None


def measured(x: torch.Tensor, truth: torch.Tensor, regions: Regions) -> dict[str, float]:
    """Contrast in the defect's place, and bias of the wall's counts."""
    contrast = defect_contrast(x, regions.defect, regions.wall)
    return {"contrast": contrast, "bias": count_bias(x, truth, regions.wall)}


@torch.no_grad()
def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("outputs/20_dcspect"))
    parser.add_argument("--name", default="cardiac", help="of the run")
    parser.add_argument("--cases", type=int, default=64, help="unseen patients")
    options = parser.parse_args()
    folder = options.runs.resolve() / options.name
    run = read_settings(folder)
    run["data"]["sizes"]["test"] = options.cases
    data = build_data(run)
    data.setup("test")
    methods = load_methods(run, folder, data.data_range)
    values: dict[str, list[dict[str, float]]] = defaultdict(list)
    for index, case in enumerate(data.sets["test"]):
        regions = regions_of(index, data)
        if regions is None:
            continue
        truth = case["volume"][0]
        volumes = {"truth": truth} | volumes_of(case, methods)
        lost = data.scenes["test"].parameters(index, TEST, data.grid)["defect_contrast"]
        for name, x in volumes.items():
            values[name].append({"lost": lost, **measured(x, truth, regions)})
    rows = [{"run": options.name, **row(name, own)} for name, own in values.items()]
    write_rows(TABLE, renewed(TABLE, rows, ("run", "method")))


def volumes_of(case: Mapping[str, object], methods: Mapping) -> dict[str, torch.Tensor]:
    """A case by every method."""
    batch = {k: v[None] for k, v in case.items() if isinstance(v, torch.Tensor)}
    return {
        label: reconstructed(method.module.own, batch).volume[0, 0]
        for label, method in methods.items()
    }


def row(name: str, values: list[dict[str, float]]) -> dict[str, object]:
    """Means and standard deviations over ill and healthy patients, and how well the contrast tells
    them apart."""
    ill = torch.tensor([one["lost"] > 0 for one in values])
    contrast, bias = (torch.tensor([one[key] for one in values]) for key in ("contrast", "bias"))
    figures = {
        "ill": int(ill.sum()),
        "contrast_ill": contrast[ill].mean(),
        "contrast_healthy": contrast[~ill].mean(),
        "spread_healthy": contrast[~ill].std(),
        "auc": binary_auroc(contrast.sigmoid(), ill.long()),
        "wall_bias": bias.mean(),
        "wall_spread": bias.std(),
    }
    digits = {k: v if isinstance(v, int) else f"{float(v):.3f}" for k, v in figures.items()}
    return {"method": name, "patients": len(values), **digits}


if __name__ == "__main__":
    main()
