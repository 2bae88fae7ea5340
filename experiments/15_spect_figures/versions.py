"""What footprints cost beside an earlier version: both are timed alternately, each in a process of
its own.

git worktree add --detach ../earlier 8c87dee2
python experiments/15_spect_figures/versions.py OUT_FOLDER ../earlier [--cameras=80]
"""

import json
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

#: Voxels and pixels along an edge, model; greatest ratio of an iteration asked for.
CASES = [
    (64, 64, "plain", 1.5), (64, 64, "mu", None), (64, 64, "blur", 1.2), (64, 64, "blur mu", 1.0),
    (128, 64, "plain", 2.5), (128, 64, "blur", 2.0), (128, 64, "blur mu", 1.8),
    (64, 256, "plain", 0.5), (64, 256, "blur", 0.3),
]  # fmt: skip
FIELD_MM, WATER, REPEATS, PROCESSES = 256.0, 0.01536, 3, 3
#: Radii in mm of a shell with activity, 1 % of the voxels.
SHELL = (30.0, 40.0)


def serve(cameras: int) -> None:
    """Time one version: build a case, or call it, as standard input asks."""
    import torch

    from mvrecon.geometry.cameras.rigs import dcspect80
    from mvrecon.geometry.grid import Grid, voxel_centres

    try:
        from mvrecon_spect.operators.projector import Spect
    except ImportError:  # as it was called before
        from mvrecon_spect.projector import Spect
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)

    def took(call: Any, *inputs: Any) -> tuple[float, Any]:
        start = time.process_time()
        made = call(*inputs)
        return time.process_time() - start, made

    def build(voxels: int, pixels: int, model: str, cameras: int) -> tuple[float, Any, Any, Any]:
        grid = Grid.centred(voxels, spacing=FIELD_MM / voxels)
        rig = dcspect80(pixels=pixels)[list(range(0, 80, 80 // cameras))]
        place = voxel_centres(grid)
        body = place[..., :2].norm(dim=-1) < 0.44 * FIELD_MM
        radius = place.norm(dim=-1)
        x = torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))[None, None]
        sparse = x * ((radius > SHELL[0]) & (radius < SHELL[1]))
        options = {"mu": WATER * body.float() if "mu" in model else None, "blur": "blur" in model}

        def first() -> Any:
            A = Spect(grid, rig, **options)
            A(x)
            return A

        return *took(first), x, sparse

    A = x = sparse = None
    for line in sys.stdin:
        if case := json.loads(line):
            build(16, 16, case[2], 1)  # the code is loaded
            first, A, x, sparse = build(*case[:3], cameras)
            answer = [max(first - took(A, x)[0], 0.0)]
        else:
            assert A is not None
            forward, y = took(A, x)
            answer = [forward, took(A.T, y)[0], took(A, sparse)[0]]
        print(json.dumps(answer), flush=True)


def ask(process: subprocess.Popen, line: Any) -> list[float]:
    """One answer of a process."""
    assert process.stdin and process.stdout
    process.stdin.write(json.dumps(line) + "\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def main(out: Path, earlier: Path, cameras: int) -> None:
    import os

    from mvrecon.core.files.runs import write_rows

    here = Path(__file__).parents[2]
    got: dict[tuple, list[list[list[float]]]] = {}
    for _ in range(PROCESSES):
        both = []
        for folder in (earlier.resolve(), here):
            path = os.pathsep.join(map(str, (folder, folder / "plugins" / "mvrecon-spect")))
            command = [sys.executable, __file__, f"--cameras={cameras}", "--serve"]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            both.append(subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path}, **pipes))
        for case in CASES:
            firsts = [ask(process, case) for process in both]
            for _ in range(REPEATS):
                timed = [ask(process, None) for process in both]
                got.setdefault(case, []).append([f + t for f, t in zip(firsts, timed, strict=True)])
            write_rows(out / "versions.csv", [row_of(*pair) for pair in got.items()])
        for process in both:
            process.communicate()


def row_of(case: tuple, timed: list[list[list[float]]]) -> dict[str, Any]:
    """A row of the table: medians of seconds, and of ratios of neighbouring calls."""
    voxels, pixels, model, floor = case
    median = statistics.median
    sums = [[forward + adjoint for _, forward, adjoint, _ in pair] for pair in timed]
    row: dict[str, Any] = {"voxels": voxels, "pixels": pixels, "model": model}
    for number, name in enumerate(("earlier", "now")):
        row[f"{name}_s"] = f"{median(pair[number] for pair in sums):.4f}"
    row |= {"ratio": f"{median(now / before for before, now in sums):.2f}", "floor": floor or ""}
    for number, name in enumerate(("earlier", "now")):
        own = [pair[number] for pair in timed]
        row[f"{name}_sparse"] = f"{median(one[3] / one[1] for one in own):.3f}"
        row[f"{name}_first_s"] = f"{median(one[0] for one in own):.3f}"
    return row


if __name__ == "__main__":
    given = [word for word in sys.argv[1:] if not word.startswith("--")]
    asked = [int(word.split("=")[1]) for word in sys.argv if word.startswith("--cameras=")]
    number = asked[0] if asked else 80
    serve(number) if "--serve" in sys.argv else main(Path(given[0]), Path(given[1]), number)
