"""MLEM, OSEM, BSREM and kernel EM of GATE's counts, by response.

python experiments/28_montecarlo/study.py COUNTS RUN_FOLDER [osem] [bsrem] [mlem] [kem]
"""

import sys
from pathlib import Path

from derenzo import BACKGROUND, GRID, HOLE, MOST, PIXELS, SEEDS, SUBSETS, run

import mvrecon as mv
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.methods.kem import kem
from mvrecon_spect.operators.projector import Spect

WEIGHT = 0.01  # of the prior
CRYSTAL = {"angles": True, "crystal_mm": 5.0, "attenuation_per_mm": 0.25}
RESPONSES = {
    "plain": {},
    "hole": {"blur": True},
    "hole, intrinsic 1.5 mm": {"blur": True, "intrinsic_mm": 1.5},
    "hole, crystal": {"blur": True, "response": CRYSTAL},
    "hole, crystal, intrinsic 1.5 mm": {"blur": True, "response": CRYSTAL, "intrinsic_mm": 1.5},
}


def kernel(A, y, monitor):
    """Kernel EM, with its kernels from four iterations of OSEM of the same counts."""
    common = {"subsets": SUBSETS, "background": BACKGROUND}
    return kem(A, y, 20, mv.osem(A, y, 4, **common)[0, 0], monitor=monitor, **common)


def penalised(A, y, monitor):
    """BSREM with the relative difference prior."""
    return bsrem(A, y, 12, WEIGHT, SUBSETS, background=BACKGROUND, monitor=monitor)


#: Method, and how many counts it takes at once.
METHODS = {
    "osem": (lambda A, y, m: mv.osem(A, y, 20, SUBSETS, BACKGROUND, monitor=m), SEEDS + 1),
    "bsrem": (penalised, SEEDS + 1),
    "mlem": (lambda A, y, m: mv.mlem(A, y, MOST, BACKGROUND, monitor=m), SEEDS + 1),
    "kem": (kernel, 1),
}


def main(counts: Path, folder: Path, methods: list[str]) -> None:
    """All responses by some methods, or by all."""
    for name, (method, batch) in METHODS.items():
        if methods and name not in methods:
            continue
        for response, options in RESPONSES.items():
            A = Spect(GRID, mv.dcspect80(pixels=PIXELS), HOLE, **options)
            names = {"version": "", "method": name, "operator": response}
            run(folder / f"{name}, {response}.pt", names, A, method, counts, batch)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
