"""Three line sources simulated by GATE, from STIR's recon_test_pack/SPECT/PinholeSPECTUB.

python experiments/28_montecarlo/stir.py PACK_FOLDER TABLE.csv
"""

import math
import sys
from pathlib import Path

import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon_spect.files.interfile_volume import read_interfile, read_mu
from mvrecon_spect.files.stir import read_stir
from mvrecon_spect.files.stir_operator import operator_of
from mvrecon_spect.methods.corrections import corrected, decay_factors

PLACES, NEAR = ((0.0, 0.0), (-10.0, 0.0), (0.0, -10.0)), 3.0  # of the sources (x, y), in mm
SUBSETS = 7
HALF_LIFE, SECONDS = 21624.0, 60.0  # of technetium, and of a view


def width(profile: Tensor, spacing: float) -> float:
    """FWHM in mm of a profile, with a parabola for its peak (NEMA NU 1)."""
    values = profile.tolist()
    k = max(range(1, len(values) - 1), key=values.__getitem__)
    a, b, c = values[k - 1 : k + 2]
    half = (b - (a - c) ** 2 / (8 * (a - 2 * b + c))) / 2
    low = next(i for i in range(k, -1, -1) if values[i] < half)
    high = next(i for i in range(k, len(values)) if values[i] < half)
    left = low + (half - values[low]) / (values[low + 1] - values[low])
    right = high - (half - values[high]) / (values[high - 1] - values[high])
    return (right - left) * spacing


def figures(x: Tensor, grid: mv.Grid) -> dict[str, str]:
    """Greatest distance from its place and FWHM of a source, and spread of their activity (standard
    deviation over mean), over the central third of their length.
    """
    depth = len(x) // 3
    flat = x[depth:-depth].double().sum(dim=0)
    place = [(torch.arange(n) - (n - 1) / 2) * grid.spacing[0] for n in x.shape[1:]]
    away, widths, activity = [], [], []
    for px, py in PLACES:
        rows, columns = ((p - q).abs() < NEAR for p, q in zip(place, (py, px), strict=True))
        part = flat[rows][:, columns]
        across, down = part.sum(dim=0), part.sum(dim=1)
        found = (across @ place[1][columns].double(), down @ place[0][rows].double())
        away.append(math.dist((px, py), [f.item() / part.sum().item() for f in found]))
        widths += [width(across, grid.spacing[0]), width(down, grid.spacing[1])]
        activity.append(part.sum().item())
    values = torch.tensor(activity)
    spread = (values.std() / values.mean()).item()
    return {
        "place_mm": f"{max(away):.2f}",
        "fwhm_mm": f"{max(widths):.3f}",
        "spread": f"{spread:.4f}",
    }


def main(pack: Path, table: Path) -> None:
    """STIR's reconstruction by one iteration of OSEM, and ours, without and with the decay."""
    scan = read_stir(*(pack / name for name in ("input.hs", "detector.txt", "collimator.txt")))
    reference, _ = read_interfile(pack / "org" / "OSEM_7.hv")
    mu, grid = read_mu(pack / "attmap.hv")
    A = operator_of(scan.system, grid, mu=mu, blur=True)
    count = A.range_shape[0]
    decay = decay_factors([SECONDS * k for k in range(count)], [SECONDS] * count, HALF_LIFE)
    seen = A(torch.ones(1, 1, *grid.shape)) > 0  # other pixels hold counts too, without a voxel
    rows = [{"made_by": "STIR"} | figures(reference, grid)]
    for name, factors in (("mvrecon", ()), ("mvrecon, decay", (decay,))):
        x = mv.osem(corrected(A, *factors), scan.counts * seen, 1, SUBSETS)
        rows.append({"made_by": name} | figures(x[0, 0], grid))
        write_rows(table, rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
