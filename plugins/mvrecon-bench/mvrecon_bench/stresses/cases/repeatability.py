"""Repeatability: identical bits in repeated calls, with more threads, and in other threads and
processes; side effects of calls.
"""

import multiprocessing
import random
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from mvrecon.core.parts import PROJECTORS, SCENES
from mvrecon.geometry.grid import Grid
from mvrecon.methods.method import build_method
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing.measures import bits
from mvrecon_bench.benchmarks.measure import threads, with_memory
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.fresh_process import LIMIT, python
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject, rig_about

#: Workload for several threads.
WORK = Grid.centred(size=(30, 29, 28), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
PIXELS = {"pixels": [70, 70], "pixel_mm": 0.19, "offset_mm": [0.04, -0.03]}
#: Loops over which memory must be constant, after a number of loops that fill caches.
LOOPS, FIRST = 200, 50
#: Timeout of other processes in seconds; a fresh process may have to compile.
PATIENCE = {"fork": 30.0, "spawn": LIMIT}
SINGLE, DOUBLE = (torch.float32,), (torch.float64,)
#: Modules that are slow to import and not required by parts.
OF_APPS = ("hydra", "lightning", "tensorboard", "matplotlib", "kornia", "scipy")


def both(subject: ProjectorSubject) -> list[Tensor]:
    """Views and adjoint of random values, in main memory."""
    A = subject.projector(WORK, rig := subject.rig(WORK, PIXELS, n_views=2))
    x, y = subject.random(1, 1, *WORK.shape), subject.random(1, 1, len(rig), *rig.shape, seed=1)
    return [A(x).cpu(), A.T(y).cpu()]


def differ(results: list[Tensor], expected: list[Tensor]) -> float:
    """Number of differing values."""
    return sum(bits(*pair) for pair in zip(results, expected, strict=True))


def again(subject: ProjectorSubject) -> float:
    """Identical bits in a second call, and with a new operator."""
    A = subject.projector(GRID, rig := subject.rig())
    x, y = subject.random(3, 2, *GRID.shape), subject.random(3, 2, len(rig), *rig.shape)
    other = subject.projector(GRID, rig)
    return differ([A(x), A.T(y), other(x), other.T(y)], 2 * [A(x), A.T(y)])


def more_threads(subject: ProjectorSubject) -> float:
    """Identical bits on 1, 2 and 8 threads."""
    results = []
    for count in (1, 2, 8):
        with threads(count):
            results.append(both(subject))
    return differ(results[1], results[0]) + differ(results[2], results[0])


def at_once(subject: ProjectorSubject) -> float:
    """One operator called concurrently by eight Python threads with different, mostly empty
    volumes.
    """
    A = subject.projector(WORK, rig := subject.rig(WORK, {"pixels": [12, 11], "pixel_mm": 1.1}))
    layers = torch.arange(WORK.shape[0], device=subject.device)[:, None, None] // 4
    volumes = [subject.random(1, 1, *WORK.shape, seed=i) * (layers == i) for i in range(8)]
    views = subject.random(8, 1, 1, len(rig), *rig.shape)
    if isinstance(A, RayTransform):
        A.skip = "box"
    expected = [A(x) for x in volumes] + [A.T(y) for y in views]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            runs = [[*pool.map(A, volumes), *pool.map(A.T, views)] for _ in range(3)]
    finally:
        sys.setswitchinterval(before)
    return sum(differ(run, expected) for run in runs)


def forked(subject: ProjectorSubject) -> float:
    """Identical bits in a forked process after the parent has used its threads, like torch's worker
    processes, on one thread.
    """
    if subject.device != "cpu" or "fork" not in multiprocessing.get_all_start_methods():
        raise DoesNotApply("a GPU's context does not survive a fork, and some systems have none")
    with threads(2):
        expected = both(subject)
        return differ(_elsewhere("fork", [subject])[0], expected)


def spawned(subject: Subject) -> float:
    """Identical bits in a fresh process."""
    kinds = [(name, dtype) for name in ("drr", "radon") for dtype in SINGLE + DOUBLE]
    ours = [ProjectorSubject("projector", name, {}, "cpu", dtype) for name, dtype in kinds]
    pairs = zip(_elsewhere("spawn", ours), map(both, ours), strict=True)
    return sum(differ(results, expected) for results, expected in pairs)


def _elsewhere(method: str, subjects: list[ProjectorSubject]) -> list[list[Tensor]]:
    with multiprocessing.get_context(method).Pool(1, torch.set_num_threads, (1,)) as pool:
        runs = pool.map_async(_numbers, subjects).get(PATIENCE[method])
    return [[torch.from_numpy(array) for array in arrays] for arrays in runs]


def _numbers(subject: ProjectorSubject) -> list[np.ndarray]:
    return [tensor.numpy() for tensor in both(subject)]


@contextmanager
def undrawn() -> Iterator[list[str]]:
    """Context that reports the global generators used inside it."""
    states: dict[str, Callable[[], object]] = {
        "random": random.getstate,
        "numpy": lambda: [
            str(part) if isinstance(part, int | float | str) else part.tobytes()
            for part in _numpy()
        ],
        "torch": lambda: torch.get_rng_state().tolist(),
        "cuda": lambda: (
            [state.tolist() for state in torch.cuda.get_rng_state_all()] if _has_gpu() else None
        ),
    }
    before, drawn = {name: state() for name, state in states.items()}, []
    yield drawn
    drawn += [name for name, state in states.items() if state() != before[name]]


def _numpy() -> tuple:
    return np.random.get_state(legacy=True)  # type: ignore[return-value]


def _has_gpu() -> bool:
    return torch.cuda.is_available() and torch.cuda.is_initialized()


def draws_nothing(subject: ProjectorSubject) -> float:
    """Construction of an operator with and without a support, its calls and derivatives."""
    x = subject.random(1, 1, *WORK.shape) * (subject.random(*WORK.shape, seed=1) > 0.9)
    with undrawn() as drawn:
        A = subject.projector(WORK, subject.rig(WORK, {"pixels": [9, 8], "pixel_mm": 1.5}))
        for B in [A, A.with_support(x[0, 0].cpu() > 0)] if isinstance(A, RayTransform) else [A]:
            views = B(x.requires_grad_())
            torch.autograd.grad(views.square().sum() + B.T(views).sum(), x)
    return float(len(drawn))


def evaluation_draws_nothing(subject: Subject) -> float:
    """Indexing scenes, evaluating a method, rendering pictures, and writing to TensorBoard."""
    from mvrecon.report.viz import review
    from mvrecon.training.callbacks import TensorBoard
    from mvrecon.training.evaluation import evaluate

    grid = Grid.centred(size=(9, 8, 7), spacing=1.0)
    rig = rig_about(grid)
    A = PROJECTORS.build("drr", grid=grid, cameras=rig)
    method = build_method({"name": "backprojection"})
    with undrawn() as drawn, TemporaryDirectory() as folder:
        scene = SCENES.build("ellipsoids").sample(3, 5, grid, rig)
        batch = {
            "views": scene.views[None],
            "volume": scene.volume[None],
            "inside": scene.inside[None],
            "name": ["0"],
        }
        scores = evaluate({"method": method}, [batch], A, 1.0)
        board = TensorBoard(folder)
        board.log_metrics({"psnr": scores["method"][0]["psnr"]}, 0)
        predicted = A(scene.volume[None])[0, 0]
        picture = review.views(scene.views[0], predicted, "0", "mm")
        board.experiment.add_image("views", picture, 0, dataformats="HWC")
        board.finalize("success")
    return float(len(drawn))


def loops(subject: ProjectorSubject) -> float:
    """Memory growth per loop of forward and backward, in volumes."""
    grid = Grid.centred(size=(34, 33, 32), spacing=1.0)
    A = subject.projector(grid, subject.rig(grid, {"pixels": [4, 4], "pixel_mm": 6.0}, n_views=2))
    x = subject.random(1, 1, *grid.shape).requires_grad_()

    def run(count: int) -> None:
        for _ in range(count):
            torch.autograd.grad(A(x).square().sum(), x)

    def grown() -> float:
        short, long = (with_memory(lambda n=n: run(n), subject.device)[1] for n in (FIRST, LOOPS))
        return long - short

    run(FIRST)
    # a leak grows both times, a heap that other work has left fragmented once
    if (least := grown()) > 0:
        least = min(least, grown())
    return least * 2**20 / (LOOPS - FIRST) / (x.numel() * x.element_size())


def imported(subject: Subject) -> float:
    """A fresh process imports all parts of mvrecon: number of imported app-only libraries, and
    whether a GPU was initialised.
    """
    code = (
        "import sys, torch\n"
        "from mvrecon.core.parts import REGISTRIES as known\n"
        "parts = [(kind, name) for kind in known for name in known[kind].names()]\n"
        "for kind, name in parts:\n"
        "    if known[kind].origin(name).startswith('mvrecon.'): known[kind].get(name)\n"
        f"print(len({set(OF_APPS)} & set(sys.modules)) + torch.cuda.is_initialized())"
    )
    done = python("-c", code)
    done.check_returncode()
    return float(done.stdout)


CASES = (
    Case(74, "repeated", "bitwise equal", "projector", again),
    Case(74, "on 1, 2 and 8 threads", "bitwise equal", "projector", more_threads),
    Case(74, "from eight threads of Python", "bitwise equal", "projector", at_once),
    Case(74, "in a forked process", "bitwise equal", "projector", forked, dtypes=SINGLE),
    Case(74, "in a spawned process", "bitwise equal", "mvrecon", spawned, dtypes=SINGLE),
    Case(75, "global random generators", "are not used", "projector", draws_nothing),
    Case(
        75,
        "global random generators",
        "are not used",
        "mvrecon",
        evaluation_draws_nothing,
        dtypes=SINGLE,
    ),
    Case(
        76,
        "memory over 200 loops",
        "grows by less than a tenth of a volume a loop",
        "projector",
        loops,
        0.1,
        SINGLE,
    ),
    Case(
        78,
        "a fresh process imports all parts",
        "no library of the apps, no GPU context",
        "mvrecon",
        imported,
        dtypes=SINGLE,
    ),
)
