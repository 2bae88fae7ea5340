"""How much of a network's SSIM the small values outside the body cost:

    python experiments/29_ray_weights/outside.py outside.csv RUN_FOLDER...

A row for each test case of each run's main method: PSNR and SSIM of its volume, and of the same
volume with values below `AIR` set to zero.
"""

import csv
import sys
from itertools import chain
from pathlib import Path

import torch

import mvrecon as mv
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
    with out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["views", "case", "psnr", "ssim", "psnr_cut", "ssim_cut", "share_cut"])
        for folder in folders:
            settings = read_settings(folder)
            data, network = build_data(settings), mv.load(folder)
            data.setup("test")
            for case in chain.from_iterable(map(single_cases, data.test_dataloader())):
                A = network.module.operator(case)
                volume = network.module(case["views"], A).volume[0]
                truth, inside = case["volume"][0], case["inside"][0]
                cut = torch.where(volume < AIR, 0, volume)
                row = [folder.parent.name, case["name"][0]]
                for x in (volume, cut):
                    row += [f"{f(x, truth, inside, data.data_range):.4f}" for f in (psnr, ssim)]
                share = ((volume > 0) & (volume < AIR) & ~inside).sum() / (~inside).sum()
                writer.writerow([*row, f"{share.item():.3f}"])


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
