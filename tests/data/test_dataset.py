"""Samples: pure in their index, in every process; orders: pure in (seed, epoch)."""

import os
import pickle
import subprocess
import sys

import pytest
import torch
from torch.utils.data import DataLoader

from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.dataset import EpochOrder, SceneDataset
from mvrecon.data.scenes.sample import Sample, Scene
from tests.data.conftest import RIG


class Counting(Scene):
    """A scene that counts its calls."""

    data_range, unit, length = 1.0, "1", None

    def __init__(self, bad=None):
        self.calls, self.bad = 0, bad

    def sample(self, index, seed, grid, cameras):
        self.calls += 1
        views = torch.full((1, 3, 10, 12), float(index))
        volume = torch.full((1, *grid.shape), float("nan") if index == self.bad else float(seed))
        return Sample(views, volume, volume > 0, f"{seed}-{index}")


@pytest.fixture
def cameras():
    return CAMERAS.from_config(RIG)


def same(a, b):
    return a["name"] == b["name"] and all(
        torch.equal(a[key], b[key]) for key in ("views", "volume", "inside")
    )


def test_every_case_is_generated_once(grid, cameras):
    scene = Counting()
    data = SceneDataset(scene, grid, cameras, [4, 2, 9], seed=3)
    items = [data[k] for k in (2, 0, 1, 2)]
    assert scene.calls == 3 and len(data) == 3
    assert [i["name"] for i in items] == ["3-9", "3-4", "3-2", "3-9"]
    assert items[0]["views"].unique().tolist() == [9.0]
    uncached = SceneDataset(Counting(), grid, cameras, [4, 2, 9], seed=3, cache=False)
    assert all(same(uncached[k], data[k]) for k in range(3)) and uncached.scene.calls == 3
    with pytest.raises(IndexError, match="3 cases has no item 3"):
        data[3]


@pytest.mark.parametrize("cache", [True, False])
def test_a_dataset_can_be_sent_to_a_worker(volume_file, grid, cameras, cache):
    scene = SCENES.build("hdf5", path=str(volume_file))
    data = SceneDataset(scene, grid, cameras, range(3), 0, cache)
    here = [data[k] for k in range(3)]
    again = pickle.loads(pickle.dumps(data))
    assert all(same(a, again[k]) for k, a in enumerate(here))


#: Workers by start method, with and without a cache of cases.
WORKERS = """
import sys, torch
from torch.utils.data import DataLoader
from mvrecon.data.dataset import SceneDataset
from mvrecon.geometry.grid import Grid
from mvrecon.core.parts import CAMERAS, SCENES
if __name__ == "__main__":
    detector = {"pixels": [6, 6], "pixel_mm": 9.0}
    cameras = CAMERAS.build("circular", n_views=2, sid=300.0, sdd=450.0, detector=detector)
    for start, cache, workers in (("fork", True, 1), ("fork", False, 2), ("spawn", False, 1)):
        scene = SCENES.build("hdf5", path=sys.argv[1])
        data = SceneDataset(scene, Grid.centred((6, 6, 6), 8.0), cameras, range(4), 1, cache)
        here = list(DataLoader(data, 2))
        options = {"num_workers": workers, "persistent_workers": workers > 1}
        there = DataLoader(data, 2, multiprocessing_context=start, **options)
        for _ in range(workers):  # those that stay go through all of it again
            for a, b in zip(here, there, strict=True):
                assert a["name"] == b["name"], start
                same = [torch.equal(a[k], b[k]) for k in ("views", "volume", "inside")]
                assert all(same), (start, cache, workers)
"""


def test_workers_load_what_the_main_process_loads(volume_file, tmp_path, root):
    """Forked and spawned ones, of cases that are cached and of those that are not."""
    script = tmp_path / "workers.py"
    script.write_text(WORKERS)
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, script, volume_file]
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr


def test_values_that_are_not_finite_are_refused(grid, cameras):
    with pytest.raises(
        ValueError, match="0-5: expected finite volume, got 512 values that are not"
    ):
        SceneDataset(Counting(bad=5), grid, cameras, [5], 0).prepare()


def test_batches_have_the_documented_shapes(grid, cameras):
    (batch,) = DataLoader(SceneDataset(Counting(), grid, cameras, range(2), 0), batch_size=2)
    assert batch["views"].shape == (2, 1, 3, 10, 12) and batch["volume"].shape == (2, 1, 8, 8, 8)
    assert batch["inside"].dtype == torch.bool and batch["name"] == ["0-0", "0-1"]


def order(seed, epoch, count=50):
    sampler = EpochOrder(count, seed)
    sampler.set_epoch(epoch)
    return list(sampler)


def test_the_order_depends_only_on_seed_and_epoch():
    torch.manual_seed(7)
    first = order(3, 2)
    torch.manual_seed(8)
    sampler = EpochOrder(50, 3)
    for epoch in (0, 5, 2):
        sampler.set_epoch(epoch)
        last = list(sampler)
    assert last == first == list(sampler)
    assert sorted(first) == list(range(50))
    assert len({tuple(order(seed, epoch)) for seed in range(3) for epoch in range(3)}) == 9


def test_a_resumed_epoch_skips_seen_cases_and_the_next_is_complete():
    sampler = EpochOrder(50, 3)
    sampler.resume(epoch=1, n_done=20)
    sampler.set_epoch(1)
    assert list(sampler) == order(3, 1)[20:]
    sampler.set_epoch(2)
    assert list(sampler) == order(3, 2)


def test_a_scene_that_draws_from_the_global_random_numbers_is_a_pure_function_and_leaves_them_alone(
    grid, cameras
):
    class Forgetful(Counting):
        def sample(self, index, seed, grid, cameras):
            made = super().sample(index, seed, grid, cameras)
            return Sample(torch.rand_like(made.views), made.volume, made.inside, made.name)

    def items(order):
        data = SceneDataset(Forgetful(), grid, cameras, [4, 2, 9], seed=3, cache=False)
        return [dict(sorted((k, data[k]) for k in order))[k] for k in range(3)]

    torch.manual_seed(1)
    expected = torch.rand(2)
    torch.manual_seed(1)
    first = items([0, 1, 2])
    assert torch.equal(torch.rand(2), expected)
    assert all(same(a, b) for a, b in zip(first, items([2, 0, 1]), strict=True))
    assert not torch.equal(first[0]["views"], first[1]["views"])


def test_worker_seeds_depend_only_on_seed_and_epoch():
    def seeds(epochs):
        sampler = EpochOrder(4, 3)
        for epoch in epochs:
            sampler.set_epoch(epoch)
            drawn = torch.rand(2, generator=sampler.generator).tolist()
        return drawn

    assert seeds([0, 1, 2]) == seeds([2]) != seeds([1])
    resumed = EpochOrder(4, 3)
    resumed.resume(epoch=2, n_done=1)
    assert list(resumed) == order(3, 2, count=4)[1:], "before Lightning tells the epoch"
