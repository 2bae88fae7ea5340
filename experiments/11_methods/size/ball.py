"""A scan as a lab has it: 16-bit counts of a ball, whose line integrals are chords, as one TIFF.

python experiments/11_methods/size/ball.py 720 1024 scan.tif
"""

import sys

import numpy as np
import tifffile

import mvrecon as mv

CENTRE_MM, RADIUS_MM, ATTENUATION = np.array([10.0, 0.0, 5.0]), 50.0, 0.02
OPEN_BEAM, PANEL_MM = 60000, 400.0


def counts(views: int, pixels: int, path: str) -> None:
    """Write the views of a full circle, one at a time."""
    panel = {"pixels": [pixels, pixels], "pixel_mm": PANEL_MM / pixels}
    rig = mv.circular(views, sid=500, sdd=1000, detector=panel)
    stack = tifffile.memmap(path, shape=(views, pixels, pixels), dtype=np.uint16, bigtiff=True)
    places = np.arange(pixels)
    for k in range(views):
        source, origin, u, v = (x[k].numpy() for x in (rig.source, rig.origin, rig.u, rig.v))
        rays = origin - source + places[None, :, None] * u + places[:, None, None] * v
        to_centre, squares = CENTRE_MM - source, (rays**2).sum(axis=-1)
        apart = to_centre @ to_centre - (rays @ to_centre) ** 2 / squares
        chords = 2 * np.sqrt(np.clip(RADIUS_MM**2 - apart, 0, None))
        stack[k] = np.round(OPEN_BEAM * np.exp(-ATTENUATION * chords))
    stack.flush()


if __name__ == "__main__":
    counts(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
