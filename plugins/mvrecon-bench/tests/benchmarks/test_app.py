"""`mvrecon-bench` as a user calls it, on sizes that take seconds."""

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.parts import PROJECTORS
from mvrecon_bench.bench import BENCHES


class Wrong:
    """A projector whose views hold two NaN, and that has neither an adjoint nor a gradient."""

    def __init__(self, grid, cameras):
        self.shape = (1, 1, len(cameras), *cameras.shape)

    def to(self, device):
        return self

    def __call__(self, x):
        views = torch.zeros(self.shape)
        views[..., 0, :2] = torch.nan
        return views

    def T(self, y):
        raise NotImplementedError("no adjoint")


class Broken:
    """A projector that does not take the geometry."""

    def __init__(self, grid, cameras):
        raise ValueError("no such\ngeometry")


class Seen:
    """Our projector, counted."""

    built = 0

    def __new__(cls, grid, cameras):
        cls.built += 1
        return PROJECTORS.build("drr", grid=grid, cameras=cameras, backend="reference")


@pytest.fixture(scope="module", autouse=True)
def registered():
    patch = pytest.MonkeyPatch()
    patch.setattr(
        PROJECTORS, "_parts", {**PROJECTORS._parts, "wrong": Wrong, "broken": Broken, "seen": Seen}
    )
    yield
    patch.undo()


PARTS = (
    "[{name: seen}, {name: wrong}, {name: broken}, {name: absent}, {name: radon, backend: "
    "reference, beam: parallel}]"
)
TINY = (
    f"bench.parts={PARTS}",
    "bench.base.n=8",
    "bench.base.views=2",
    "bench.base.device=cpu",
    "bench.plan.sizes.vary.n=[6]",
    "~bench.plan.axes",
    "+bench.plan.rest={vary: {camera: [parallel], dtype: [float64]}}",
    "bench.rays=2",
    "bench.repeats=2",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory, call):
    folder = tmp_path_factory.mktemp("bench") / "operators"
    return folder, call(folder, *TINY)


def test_a_run_folder_contains_the_documented_files(run):
    names = {path.name for path in run[0].iterdir()}
    assert {"results.csv", "pareto.png", "table.md", "versions.txt", "config.yaml"} <= names
    assert any(name.startswith("events.") for name in names)
    assert "processor" in (run[0] / "versions.txt").read_text()


def test_every_column_is_there_and_documented(run):
    folder, rows = run
    figures = ("forward_ms", "adjoint_ms", "error_thin", "error_pixel", "peak_mb")
    assert {"part", "backend", "device", "dtype", "scene", "camera", "n", *figures} <= set(rows[0])
    table = (folder / "table.md").read_text()
    assert all(f"| {name} | " in table for name in rows[0])


def test_a_good_part_has_every_figure(run):
    good = [row for row in run[1] if row["part"] == "seen" and row["camera"] == "circular"]
    assert [(row["n"], row["dtype"]) for row in good] == [
        ("6", "float32"),
        ("8", "float32"),
        ("8", "float64"),
    ]
    for row in good:
        assert row["status"] == "ok" and row["nans"] == "0" and row["repeatable"] == "yes"
        assert 0 < float(row["error_pixel"]) < float(row["error_thin"]) < 0.3
        assert all(
            float(row[f"{c}_ms"]) > 0
            for c in ("forward", "adjoint", "volume_grad", "pose_grad", "first")
        )
        assert float(row["adjointness"]) < (1e-12 if row["dtype"] == "float64" else 1e-6)
        assert int(row["calls"]) >= 2
        assert 0 < float(row["pose_cosine"]) <= 1


def test_a_wrong_part_is_distinguished_from_a_correct_one(run):
    row = next(row for row in run[1] if row["part"] == "wrong")
    assert row["status"] == "ok" and row["nans"] == "4" and row["error_thin"] == "inf"
    assert "no adjoint" in row["note"] and row["adjoint_ms"] == "" and row["pose_cosine"] == ""
    assert row["repeatable"] == "yes"  # the same NaN twice


def test_failures_are_rows_with_a_reason(run):
    folder, rows = run
    status = {
        row["part"]: row["status"]
        for row in rows
        if row["status"] != "ok" and row["camera"] == "circular"
    }
    assert status["broken"] == "skipped: ValueError: no such"
    assert status["absent"].startswith("skipped: LookupError: No projector is named 'absent'")
    reasons = [
        row["status"] for row in rows if row["part"] == "seen" and row["camera"] == "parallel"
    ]
    assert len(reasons) == 1 and "needs central cameras" in reasons[0]
    assert {row["camera"] for row in rows if row["part"] == "radon"} == {"parallel"}
    assert "No projector is named" in (folder / "table.md").read_text()


def test_a_restart_measures_only_what_is_missing(run, call):
    folder, rows = run
    built, text = Seen.built, (folder / "results.csv").read_text()
    assert call(folder, *TINY) == rows and Seen.built == built
    lines = text.splitlines(keepends=True)
    gone = next(
        n for n, row in enumerate(rows, start=1) if row["part"] == "seen" and row["n"] == "6"
    )
    (folder / "results.csv").write_text("".join(lines[:gone] + lines[gone + 1 :]))
    again = call(folder, *TINY)
    assert len(again) == len(rows) and Seen.built > built
    assert again[:-1] == rows[: gone - 1] + rows[gone:] and again[-1]["n"] == "6"


def test_the_board_shows_figures_picture_and_text(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    tags = EventAccumulator(str(run[0])).Reload().Tags()
    assert {"forward_ms/seen", "error_thin/seen"} <= set(tags["scalars"]) and "pareto" in tags[
        "images"
    ]
    assert any("table" in tag for tag in tags["tensors"])


def test_scaling_runs_and_fits(tmp_path, call):
    vary = "{voxels: [4, 8], channels: [1, 4]}"
    parts = "bench.parts=[{name: seen}, {name: broken}]"
    options = ("bench=scaling", parts, "~bench.vary", f"+bench.vary={vary}", "bench.repeats=2")
    base = (
        "bench.base={n: 6, pixels: 6, views: 2, batch: 1, channels: 1, threads: 1, device: "
        "cpu, dtype: float32}"
    )
    rows = call(tmp_path, *options, base)
    done = [row for row in rows if row["status"] == "ok"]
    assert [(row["axis"], row["size"]) for row in done] == [
        ("voxels", "64"), ("voxels", "512"), ("channels", "1"), ("channels", "4")
    ]  # fmt: skip
    assert (
        all(float(row["forward_ms"]) > 0 and float(row["adjoint_ms"]) > 0 for row in done)
        and len(rows) == 8
    )
    assert "| seen | channels | adjoint | 1 to 4 |" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "scaling.png").exists()


@pytest.mark.parametrize(
    "kind", ["operators", "scaling", "methods", "precision", "skip", "emission"]
)
def test_the_shipped_settings_match_the_code(kind):
    bench = BENCHES.from_config(compose(f"bench={kind}", config_name="bench")["bench"])
    rows = [job.row for group in bench.groups() for job in group]
    assert rows and set(rows[0]) <= set(bench.columns) and set(bench.keys) <= set(rows[0])
    assert len({tuple(str(row[key]) for key in bench.keys) for row in rows}) == len(rows)


def test_an_unknown_axis_and_an_unknown_beam_are_refused():
    with pytest.raises(ValueError, match="axis must be one of voxels.*got 'weight'"):
        BENCHES.build("scaling", parts=[], base={}, vary={"weight": [1]})
    with pytest.raises(ValueError, match="beam of central, parallel"):
        BENCHES.build("operators", parts=[{"name": "drr", "beam": "fan"}], base={}, plan={})
