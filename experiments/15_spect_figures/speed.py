"""What SPECT costs: attenuation and blur over line integrals, for activity everywhere and in a
ball; OSEM; events a second.

python experiments/15_spect_figures/speed.py OUT_FOLDER [--smaller]
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.core.files.runs import write_rows
from mvrecon.geometry.grid import voxel_centres
from mvrecon_spect.events.app import EventsSettings, simulate_events
from mvrecon_spect.operators.projector import Spect

WATER, FIELD_MM, REPEATS, EVENTS = 0.01536, 192.0, 5, 16
#: What is timed, with its options beside mu.
KINDS = {"plain": {}, "attenuated": {}, "blurred": {"blur": True}}


def scene(voxels: int) -> tuple[mv.Grid, torch.Tensor, dict[str, torch.Tensor]]:
    """A grid, the attenuation of a torso of water in it, and activities [1 1 d h w]: everywhere,
    and in a ball of radius 40 mm.
    """
    grid = mv.Grid.centred(voxels, spacing=FIELD_MM / voxels)
    place = voxel_centres(grid).float()
    torso = ((place[..., 0] / 90) ** 2 + (place[..., 1] / 75) ** 2 < 1).float()
    ball = ((place - torch.tensor([30.0, 20.0, 10.0])).norm(dim=-1) < 40).float()
    return grid, WATER * torso, {"full": torch.ones(1, 1, *grid.shape), "ball": ball[None, None]}


def ratios(voxels: int, pixels: int) -> list[dict[str, str]]:
    """Processor seconds of one thread, and ratios to the line integrals, measured alternately."""
    torch.set_num_threads(1)
    grid, mu, activities = scene(voxels)
    cameras = mv.dcspect80(pixels=pixels)
    operators = {
        kind: Spect(grid, cameras, mu=None if kind == "plain" else mu, **options)
        for kind, options in KINDS.items()
    }
    rows = []
    for activity, x in activities.items():
        seconds: dict[tuple[str, str], list[float]] = {}
        for _ in range(REPEATS + 1):
            for kind, A in operators.items():
                start = time.process_time()
                y = A(x)
                middle = time.process_time()
                A.T(y)
                ends = {"forward": middle - start, "adjoint": time.process_time() - middle}
                for way, took in ends.items():
                    seconds.setdefault((kind, way), []).append(took)
        median = {key: statistics.median(took[1:]) for key, took in seconds.items()}
        rows += [
            {"what": f"{kind}, {activity}, {way}, {voxels}^3, 80 x {pixels}^2"}
            | {"seconds": f"{took:.3f}", "over_plain": f"{took / median['plain', way]:.2f}"}
            for (kind, way), took in median.items()
        ]
    return rows


def iterations(voxels: int, pixels: int) -> dict[str, str]:
    """Wall seconds of 5 attenuated OSEM iterations of 20 subsets on two threads."""
    torch.set_num_threads(2)
    grid, mu, activities = scene(voxels)
    A = Spect(grid, mv.dcspect80(pixels=pixels), mu=mu)
    ideal = A(activities["ball"])
    rng = torch.Generator().manual_seed(0)
    counts = torch.poisson(ideal * (5e5 / ideal.sum()), generator=rng)
    mv.osem(A, counts, 1, 20)
    start = time.perf_counter()
    mv.osem(A, counts, 5, 20)
    took = time.perf_counter() - start
    return {
        "what": f"5 attenuated OSEM iterations, {voxels}^3, 80 x {pixels}^2",
        "seconds": f"{took:.2f}",
    }


def events(voxels: int, pixels: int) -> dict[str, str]:
    """Wall seconds an event of `mvrecon-events experiment=events` with two workers."""
    sizes = [f"grid.size=[{voxels},{voxels},{voxels}]", f"grid.spacing={256 / voxels}"]
    asked = [f"camera.pixels={pixels}", f"events.count={EVENTS}", f"events.shard={EVENTS // 4}"]
    settings = compose("experiment=events", *sizes, *asked, config_name="events")
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        simulate_events(EventsSettings(**settings), Path(folder))
        took = (time.perf_counter() - start) / EVENTS
    return {"what": f"an event, {voxels}^3, 80 x {pixels}^2", "seconds": f"{took:.3f}"}


def main(out: Path, voxels: int, pixels: int) -> None:
    rows = ratios(voxels, pixels)
    rows += [
        row | {"over_plain": ""} for row in (iterations(voxels, pixels), events(voxels, pixels))
    ]
    write_rows(out / "speed.csv", rows)


if __name__ == "__main__":
    size = (32, 16) if "--smaller" in sys.argv else (64, 64)
    main(Path(sys.argv[1]), *size)
