"""How much of a network's SSIM the small values outside the body cost:

    python experiments/29_ray_weights/outside.py outside.csv RUN_FOLDER...

A row for each test case of each run's main method: PSNR and SSIM of its volume, and of the same
volume with values below `AIR` set to zero.
"""

import sys
from itertools import chain
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.dataset import single_cases
from mvrecon.report.metrics import psnr, ssim
from mvrecon.training.fit import build_data
from mvrecon.training.run_folder import read_settings

#: 2.6 % of water, in 1/mm.
AIR = 5e-4


@torch.no_grad()
def main(out: Path, folders: list[Path]) -> None:
    """Reconstruct and measure."""
    torch.set_num_threads(1)
    rows = []
    for folder in folders:
        data, network = build_data(read_settings(folder)), mv.load(folder)
        data.setup("test")
        for case in chain.from_iterable(map(single_cases, data.test_dataloader())):
            volume = network.module(case["views"], network.module.operator(case)).volume[0]
            truth, inside = case["volume"][0], case["inside"][0]
            row = {"views": folder.parent.name, "case": case["name"][0]}
            for end, x in (("", volume), ("_cut", torch.where(volume < AIR, 0, volume))):
                for figure in (psnr, ssim):
                    value = figure(x, truth, inside, data.data_range)
                    row[f"{figure.__name__}{end}"] = f"{value:.4f}"
            share = ((volume > 0) & (volume < AIR) & ~inside).sum() / (~inside).sum()
            rows.append({**row, "share_cut": f"{share.item():.3f}"})
    write_rows(out, rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
