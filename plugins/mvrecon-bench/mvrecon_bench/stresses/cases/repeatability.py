"""Repeatability: identical bits in repeated calls, with more threads, and in other threads and
processes; side effects of calls.
"""

import math
import multiprocessing
import pickle
import random
import sys
from collections.abc import Iterator
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
from mvrecon_bench.measure import threads, with_memory
from mvrecon_bench.stresses.case import BOTH, SINGLE, DoesNotApply, case
from mvrecon_bench.stresses.fresh_process import LIMIT, python
from mvrecon_bench.stresses.subject import ProjectorSubject, Subject, rig_about

#: Workload for several threads.
WORK = Grid.centred(size=(30, 29, 28), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
PIXELS = {"pixels": [70, 70], "pixel_mm": 0.19, "offset_mm": [0.04, -0.03]}
#: Loops over which memory must be constant, after a number of loops that fill caches.
LOOPS, FIRST = 200, 50
#: Timeout of other processes in seconds; a fresh process may have to compile.
PATIENCE = {"fork": 30.0, "spawn": LIMIT}
#: Modules that are slow to import and not required by parts.
OF_APPS = ("hydra", "lightning", "tensorboard", "matplotlib", "kornia", "scipy")
IMPORTS = f"""
import sys, torch
from mvrecon.core.parts import REGISTRIES as known
parts = [(kind, name) for kind in known for name in known[kind].names()]
for kind, name in parts:
    if known[kind].origin(name).startswith('mvrecon.'): known[kind].get(name)
print(len({set(OF_APPS)} & set(sys.modules)) + torch.cuda.is_initialized())
"""


def both(subject: ProjectorSubject) -> list[Tensor]:
    """Views and adjoint of random values, in main memory."""
    A, x, y = subject.pair(WORK, detector=PIXELS, n_views=2)
    return [A(x).cpu(), A.T(y).cpu()]


def differ(results: list[Tensor], expected: list[Tensor]) -> float:
    """Number of differing values."""
    return sum(bits(*pair) for pair in zip(results, expected, strict=True))


@case("projector", 74)
def again(subject: ProjectorSubject) -> float:
    """Repeated: bitwise equal, also with a new operator."""
    A, x, y = subject.pair(batch=3, channels=2)
    other = subject.pair()[0]
    return differ([A(x), A.T(y), other(x), other.T(y)], 2 * [A(x), A.T(y)])


@case("projector", 74)
def more_threads(subject: ProjectorSubject) -> float:
    """On 1, 2 and 8 threads: bitwise equal."""
    results = []
    for count in (1, 2, 8):
        with threads(count):
            results.append(both(subject))
    return differ(results[1], results[0]) + differ(results[2], results[0])


@case("projector", 74)
def at_once(subject: ProjectorSubject) -> float:
    """From eight threads of Python: bitwise equal, with different, mostly empty volumes."""
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


@case("projector", 74, 0.0, SINGLE)
def forked(subject: ProjectorSubject) -> float:
    """In a forked process: bitwise equal, after the parent has used its threads."""
    if subject.device != "cpu" or "fork" not in multiprocessing.get_all_start_methods():
        raise DoesNotApply("a GPU's context does not survive a fork, and some systems have none")
    with threads(2):
        expected = both(subject)
        return differ(_elsewhere("fork", [subject])[0], expected)


@case("mvrecon", 74, 0.0, SINGLE)
def spawned(_: Subject) -> float:
    """In a spawned process: bitwise equal."""
    kinds = [(name, dtype) for name in ("drr", "radon") for dtype in BOTH]
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
    before, drawn = _states(), []
    yield drawn
    drawn += [name for name, state in _states().items() if state != before[name]]


def _states() -> dict[str, object]:
    gpu = torch.cuda.is_available() and torch.cuda.is_initialized()
    return {
        "random": random.getstate(),
        "numpy": pickle.dumps(np.random.get_state()),
        "torch": torch.get_rng_state().tolist(),
        "cuda": [state.tolist() for state in torch.cuda.get_rng_state_all()] if gpu else None,
    }


@case("projector", 75)
def draws_nothing(subject: ProjectorSubject) -> float:
    """Global random generators: are not used by construction, calls and derivatives."""
    x = subject.random(1, 1, *WORK.shape) * (subject.random(*WORK.shape, seed=1) > 0.9)
    with undrawn() as drawn:
        A = subject.projector(WORK, subject.rig(WORK, {"pixels": [9, 8], "pixel_mm": 1.5}))
        for B in [A, A.with_support(x[0, 0].cpu() > 0)] if isinstance(A, RayTransform) else [A]:
            views = B(x.requires_grad_())
            torch.autograd.grad(views.square().sum() + B.T(views).sum(), x)
    return float(len(drawn))


@case("mvrecon", 75, 0.0, SINGLE)
def evaluation_draws_nothing(_: Subject) -> float:
    """Global random generators: are not used by scenes, evaluation, pictures and TensorBoard."""
    from mvrecon.data.dataset import Batch
    from mvrecon.report.viz import review
    from mvrecon.training.callbacks import TensorBoard
    from mvrecon.training.evaluation import evaluate

    grid = Grid.centred(size=(9, 8, 7), spacing=1.0)
    rig = rig_about(grid)
    A = PROJECTORS.build("drr", grid=grid, cameras=rig)
    method = build_method({"name": "backprojection"})
    with undrawn() as drawn, TemporaryDirectory() as folder:
        scene = SCENES.build("ellipsoids").sample(3, 5, grid, rig)
        tensors = {name: getattr(scene, name)[None] for name in ("views", "volume", "inside")}
        scores = evaluate({"method": method}, [Batch(**tensors, name=["0"])], A, 1.0)
        board = TensorBoard(folder)
        board.log_metrics({"psnr": scores["method"][0]["psnr"]}, 0)
        picture = review.views(scene.views[0], A(scene.volume[None])[0, 0], "0", "mm")
        board.experiment.add_image("views", picture, 0, dataformats="HWC")
        board.finalize("success")
    return float(len(drawn))


@case("projector", 76, 0.1, SINGLE)
def loops(subject: ProjectorSubject) -> float:
    """Memory over 200 loops: grows by less than a tenth of a volume a loop."""
    grid = Grid.centred(size=(34, 33, 32), spacing=1.0)
    A, x, _ = subject.pair(grid, detector={"pixels": [4, 4], "pixel_mm": 6.0}, n_views=2)
    x.requires_grad_()

    def run(count: int) -> None:
        for _ in range(count):
            torch.autograd.grad(A(x).square().sum(), x)

    def grown() -> float:
        short, long = (with_memory(lambda n=n: run(n), subject.device)[1] for n in (FIRST, LOOPS))
        return long - short

    run(FIRST)
    # a leak grows both times, a heap that other work has left fragmented once
    if math.isnan(least := grown()):
        raise DoesNotApply("memory is measured on Linux and on a GPU")
    if least > 0:
        least = min(least, grown())
    return least * 2**20 / (LOOPS - FIRST) / (x.numel() * x.element_size())


@case("mvrecon", 78, 0.0, SINGLE)
def imported(_: Subject) -> float:
    """A fresh process imports all parts: no library of the apps, no GPU context."""
    done = python("-c", IMPORTS)
    done.check_returncode()
    return float(done.stdout)
