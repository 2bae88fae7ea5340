"""The result table against methods whose answers are known."""

import io
import math
import sys
from dataclasses import asdict

import numpy as np
import pytest
import torch
from PIL import Image as Pillow
from rich.console import Console
from torch import nn

from mvrecon.core.parts import METRICS
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.geometry.grid import Grid
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.report.metrics import mean_and_spread
from mvrecon.report.result_table import TERMINAL_COLUMNS, remarks, table
from mvrecon.report.viz.images import save_png
from mvrecon.training.evaluation import evaluate
from mvrecon.training.export import save_case

SHAPE = (8, 8, 8)


class Shadow(Projector):
    """The sum along z, seen by two equal cameras."""

    def forward(self, volume):
        return volume.sum(dim=2)[:, :, None].expand(-1, -1, 2, -1, -1)


class Scaled(nn.Module):
    """The views spread evenly along z, times a factor."""

    def __init__(self, factor):
        super().__init__()
        self.factor = factor

    def forward(self, views, A):
        volume = views[:, :, :1].expand(-1, -1, SHAPE[0], -1, -1) / SHAPE[0]
        return Reconstruction(volume=self.factor * volume)


def batches():
    flat = 0.1 + torch.rand(3, 1, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    volume = flat.expand(-1, -1, 8, -1, -1)
    inside = torch.zeros(volume.shape, dtype=torch.bool)
    inside[..., 2:6] = True
    views = Shadow()(volume)
    yield {"views": views[:2], "volume": volume[:2], "inside": inside[:2], "name": ["a", "b"]}
    yield {"views": views[2:], "volume": volume[2:], "inside": inside[2:], "name": ["c"]}


def scores(see=None):
    return evaluate(
        {"exact": Scaled(1.0), "low": Scaled(0.75)}, batches(), Shadow(), 1.0, on_scene=see
    )


def test_every_scene_counts_once_for_any_batch_size():
    found = scores()
    assert {label: len(each) for label, each in found.items()} == {"exact": 3, "low": 3}
    for score in found["low"]:
        assert score["nrmse"] == pytest.approx(0.25, abs=1e-5)
        assert score["nrmse_inside"] == pytest.approx(0.25, abs=1e-5)
        assert score["view_nrmse"] == pytest.approx(0.25, abs=1e-5)
    assert all(score["nrmse"] < 1e-6 and score["ssim"] > 0.9999 for score in found["exact"])
    assert all(score["ms"] > 0 for each in found.values() for score in each)


def test_each_scene_is_shown_with_all_reconstructions():
    seen = []
    scores(
        lambda scene, volumes: seen.append(
            (scene["name"], sorted(volumes), tuple(scene["views"].shape))
        )
    )
    assert seen == [([name], ["exact", "low"], (1, 1, 2, 8, 8)) for name in "abc"]


class Hoarding(Scaled):
    """Needs 16 MiB in pieces that the C library keeps for the next call."""

    def forward(self, views, A):
        pieces = [torch.ones(1 << 14) for _ in range(256)]
        return super().forward(views * pieces[-1][0], A)


def test_the_memory_of_a_call_includes_what_an_earlier_one_has_returned():
    for _ in range(2):
        found = evaluate({"hoarding": Hoarding(1.0)}, batches(), Shadow(), 1.0)["hoarding"]
        needed = [score["bytes"] for score in found]
        assert needed[1:] == [None, None]
        assert sys.platform != "linux" or 14 * 2**20 < needed[0] < 40 * 2**20


def test_mean_and_spread():
    assert mean_and_spread([1.0, 2.0, 3.0]) == {"mean": 2.0, "std": 1.0, "values": [1.0, 2.0, 3.0]}
    assert math.isnan(mean_and_spread([5.0])["std"])
    assert mean_and_spread([1.0, math.nan, 3.0])["mean"] == 2
    assert mean_and_spread([math.inf, 3.0])["mean"] == math.inf
    assert math.isnan(mean_and_spread([math.nan])["mean"])


def test_the_table_contains_every_method_with_mean_and_deviation():
    row = {name: {"mean": 0.5, "std": 0.125, "values": [0.5]} for name in METRICS.names()}
    row |= {"parameters": 12345, "ms_per_volume": 1.25, "train_seconds": 61.0, "train_steps": 7}
    sharp = {**row, "psnr": {"mean": math.inf, "std": math.nan, "values": []}, "train_steps": 0}
    found = {"name": "trial", "scenes": ["a", "b"], "seen_in_training": []}
    found["methods"] = {"cross_view": row, "sirt": sharp}
    text = shown(found)
    for piece in (
        "trial: 2 unseen scenes",
        "cross_view",
        "sirt",
        "12,345",
        "0.500",
        "± 0.125",
        "± 0.12",
        "inf",
        "61",
    ):
        assert piece in text, piece
    assert "nan" not in text and "…" not in text
    title = shown({**found, "scenes": ["a"]}).splitlines()[0]
    assert title.strip() == "trial: 1 unseen scene"


@pytest.mark.parametrize(
    ("scenes", "seen", "title"),
    [
        (["a", "b"], ["b"], "trial: 2 scenes, 1 of them seen in training, mean"),
        (["a"], ["a"], "trial: 1 scene, 1 of them seen in training"),
        (["a", "b"], None, "trial: 2 scenes, not known whether seen in training"),
    ],
)
def test_a_table_calls_no_scene_unseen_that_a_training_may_have_seen(scenes, seen, title):
    """The table of scenes that a training has seen, or may have, does not call them unseen."""
    text = shown({"name": "trial", "scenes": scenes, "seen_in_training": seen, "methods": {}})
    assert title in text and "unseen" not in text


def test_the_table_reports_shared_cases_and_the_detector():
    """Notes below the table list cases shared by training and test, and a detector that is not
    ideal or not the run's.
    """
    perfect = asdict(Acquisition())
    noisy = perfect | {"photons": 1e4, "blur_mm": 2.0}
    assert remarks({"acquisition": perfect, "overlap": False}) == []
    assert remarks({"acquisition": noisy, "overlap": True}) == [
        "The views' detector: blur_mm 2, photons 10000",
        "data.overlap: training, validation and test share their cases",
    ]
    lines = remarks({"acquisition": perfect, "acquisition_of_run": noisy})
    assert lines == ["The run's detector was another: blur_mm 2, photons 10000"]
    whole = asdict(Acquisition.of({"disturbed": {"views": 3, "shift_px": 1.0}}))
    short = perfect | {"disturbed": {"views": 3, "shift_px": 1.0}}
    (line,) = remarks({"acquisition": whole, "acquisition_of_run": short})
    assert line == "The views' detector: disturbed.views 3, disturbed.shift_px 1"


def shown(found):
    text = io.StringIO()
    Console(file=text, width=TERMINAL_COLUMNS).print(table(found))
    return text.getvalue()


def test_a_saved_case_keeps_axes_and_affine(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    grid = Grid.centred(size=(8, 7, 6), spacing=(1.0, 2.0, 3.0), centre=(10.0, 20.0, 30.0))
    volume = torch.zeros(1, 1, 6, 7, 8)
    volume[0, 0, 5, 4, 3] = 1.0
    scene = {"views": torch.rand(1, 1, 2, 4, 4), "volume": volume, "name": ["pat/1 a"]}
    case = save_case(tmp_path, scene, {"sirt": volume * 2}, grid, 1.0)
    assert sorted(p.name for p in case.iterdir()) == [
        "planes.png",
        "sirt.nii.gz",
        "truth.nii.gz",
        "views.png",
    ]
    image = nibabel.load(case / "sirt.nii.gz")
    assert image.shape == (8, 7, 6) and image.get_fdata()[3, 4, 5] == 2
    world = image.affine @ [3, 4, 5, 1]
    assert world[:3] == pytest.approx(grid.to_world(torch.tensor([3.0, 4.0, 5.0])).tolist())


def test_a_saved_image_round_trips_without_temporary_files(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (7, 9, 3), np.uint8)
    save_png(tmp_path / "review" / "a.png", image)
    assert (np.asarray(Pillow.open(tmp_path / "review" / "a.png")) == image).all()
    assert [p.name for p in (tmp_path / "review").iterdir()] == ["a.png"]
