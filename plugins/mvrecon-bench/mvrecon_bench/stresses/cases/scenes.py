"""Scenes: cases as pure functions of seed and index, truth and views of one object."""

from collections.abc import Iterator

import torch

from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.testing import check_scene
from mvrecon.testing.measures import gap, greatest
from mvrecon.testing.scene import GRID, RIG
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.scene_subject import SEED, SceneSubject

#: Cases are float32, independent of the dtype under test.
SINGLE = (torch.float32,)
#: Tolerance relative to the content of a truth sampled at voxel centres.
SAMPLED = 0.05
#: Numbers of torch threads.
THREADS = (1, 2, 3)


def contract(subject: SceneSubject) -> float:
    """`mvrecon.testing.check_scene`."""
    subject.case()  # raises DoesNotApply if it cannot be built
    try:
        check_scene(subject.name, **subject.coarser, **subject.options)
    except AssertionError:
        subject.need_whole()
        raise
    return 0.0


def differing(a: Sample, b: Sample) -> int:
    """Number of fields among views, truth, mask and name that differ between two cases."""
    pairs = [(getattr(a, what), getattr(b, what)) for what in ("views", "volume", "inside")]
    return sum(not torch.equal(*pair) for pair in pairs) + (a.name != b.name)


def in_any_order(subject: SceneSubject) -> float:
    """Identical bits of a case in any order, from a new scene, and with another global random
    state.
    """
    subject.need_two()
    first, second = subject.case(0), subject.case(1)
    other = subject.scene()
    torch.manual_seed(17)
    backwards = subject.case(1, scene=other), subject.case(0, scene=other)
    return differing(second, backwards[0]) + differing(first, backwards[1])


def on_any_threads(subject: SceneSubject) -> float:
    """Identical bits of a case for any number of threads."""
    before, cases = torch.get_num_threads(), []
    try:
        for threads in THREADS:
            torch.set_num_threads(threads)
            cases.append(subject.case())
    finally:
        torch.set_num_threads(before)
    return sum(differing(cases[0], case) for case in cases[1:])


def others_random_numbers(subject: SceneSubject) -> float:
    """Use of torch's global generator by a case."""
    subject.case()
    state = torch.get_rng_state()
    subject.case()
    return float((torch.get_rng_state() != state).sum())


def camera_by_camera(subject: SceneSubject) -> float:
    """Views of single cameras, and of cameras in another order, equal those of the full rig."""
    together = subject.case().views
    alone = [(subject.case(cameras=RIG[[m]]).views[:, 0], together[:, m]) for m in range(len(RIG))]
    order = list(reversed(range(len(RIG))))
    turned = subject.case(cameras=RIG[order]).views
    return greatest(gap(a, b) for a, b in (*alone, (turned, together[:, order])))


def finer_truth(subject: SceneSubject) -> float:
    """On a grid of half the spacing, the object has the truth's content (value times mm^3)."""
    scene = subject.used
    if type(scene).finer is Scene.finer:
        raise DoesNotApply("it gives no object on a finer grid")
    coarse = subject.case().volume  # raises here if not supported
    fine = scene.finer(0, SEED, GRID, RIG, 2)
    return abs(float(fine.double().sum() / 8 / coarse.double().sum()) - 1)


def apart(subject: SceneSubject) -> float:
    """Number of identical pairs of cases with different indices or seeds."""
    subject.need_two()
    return float(sum(torch.equal(a.volume, b.volume) for a, b in _pairs(subject)))


def _pairs(subject: SceneSubject) -> Iterator[tuple[Sample, Sample]]:
    first = subject.case()
    yield first, subject.case(1)
    if subject.used.length is None:
        yield first, subject.used.sample(0, SEED + 1, GRID, RIG)


CASES = (
    Case(
        21,
        "views of single cameras",
        "equal to those of the whole rig",
        "scene",
        camera_by_camera,
        1e-6,
        SINGLE,
    ),
    Case(61, "contract of a scene", "passes", "scene", contract, dtypes=SINGLE),
    Case(74, "cases in any order", "bitwise equal", "scene", in_any_order, dtypes=SINGLE),
    Case(74, "a case on 1, 2 and 3 threads", "bitwise equal", "scene", on_any_threads, 0.0, SINGLE),
    Case(
        75,
        "global random generators",
        "are not used",
        "scene",
        others_random_numbers,
        dtypes=SINGLE,
    ),
    Case(57, "two indices, two seeds", "different cases", "scene", apart, dtypes=SINGLE),
    Case(
        58,
        "the object on a finer grid",
        "the same total as the truth",
        "scene",
        finer_truth,
        SAMPLED,
        SINGLE,
    ),
)
