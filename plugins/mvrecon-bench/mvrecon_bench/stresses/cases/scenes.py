"""Scenes: cases as pure functions of seed and index, truth and views of one object."""

import torch

from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.testing import check_scene
from mvrecon.testing.measures import bits, gap, greatest
from mvrecon.testing.scene import GRID, RIG
from mvrecon_bench.measure import threads
from mvrecon_bench.stresses.case import SINGLE, DoesNotApply, case
from mvrecon_bench.stresses.subjects import SceneSubject


def differing(a: Sample, b: Sample) -> int:
    """Number of fields among views, truth, mask and name that differ between two cases."""
    pairs = [(getattr(a, what), getattr(b, what)) for what in ("views", "volume", "inside")]
    return sum(not torch.equal(*pair) for pair in pairs) + (a.name != b.name)


@case("scene", 21, 1e-6, SINGLE)
def camera_by_camera(subject: SceneSubject) -> float:
    """Views of single cameras: equal to those of the whole rig, also in another order."""
    together = subject.sample().views
    orders = [[m] for m in range(len(RIG))] + [list(reversed(range(len(RIG))))]
    return greatest(
        gap(subject.sample(cameras=RIG[order]).views, together[:, order]) for order in orders
    )


@case("scene", 58, 0.05, SINGLE)
def finer_truth(subject: SceneSubject) -> float:
    """The object on a finer grid: the same total as the truth, sampled at voxel centres."""
    scene = subject.used
    if type(scene).finer is Scene.finer:
        raise DoesNotApply("it gives no object on a finer grid")
    coarse = subject.sample().volume  # raises here if not supported
    fine = scene.finer(0, 3, GRID, RIG, 2)
    return abs(float(fine.double().sum() / 8 / coarse.double().sum()) - 1)


@case("scene", 61, 0.0, SINGLE)
def contract(subject: SceneSubject) -> float:
    """Contract of a scene: passes."""
    subject.sample()  # raises DoesNotApply if it cannot be built
    try:
        check_scene(subject.name, **subject.coarser, **subject.options)
    except AssertionError:
        subject.need_whole()
        raise
    return 0.0


@case("scene", 74, 0.0, SINGLE)
def in_any_order(subject: SceneSubject) -> float:
    """Cases in any order: bitwise equal, from a new scene and with another global random state."""
    subject.need_two()
    first, second, other = subject.sample(0), subject.sample(1), subject.scene()
    torch.manual_seed(17)
    return differing(second, subject.sample(1, of=other)) + differing(
        first, subject.sample(of=other)
    )


@case("scene", 74, 0.0, SINGLE)
def on_any_threads(subject: SceneSubject) -> float:
    """A case on 1, 2 and 3 threads: bitwise equal."""
    samples = []
    for count in (1, 2, 3):
        with threads(count):
            samples.append(subject.sample())
    return sum(differing(samples[0], sample) for sample in samples[1:])


@case("scene", 75, 0.0, SINGLE)
def others_random_numbers(subject: SceneSubject) -> float:
    """Global random generators: are not used."""
    subject.sample()
    state = torch.get_rng_state()
    subject.sample()
    return bits(torch.get_rng_state(), state)
