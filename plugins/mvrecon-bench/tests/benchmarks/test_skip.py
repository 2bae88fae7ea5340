"""`mvrecon-bench bench=skip` on sizes that take seconds."""

import lightning
import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.training.module import ReconstructionModule
from mvrecon_bench.benchmarks import plots, skip_report
from mvrecon_bench.benchmarks.kinds import BENCHES
from mvrecon_bench.benchmarks.skip_tasks import TASKS

pytest.importorskip("matplotlib")

N = 12
MODEL = (
    "{n: 12, rig: {name: circular, n_views: 2, sid: 1000.0, sdd: 1536.0, cover: 1.536, "
    "pixels: 12}, "
    "cases: 2,"
    " modes: [auto, hull], checkpoints: {heart: null}, method: {name: cross_view, "
    "widths: [4, 8], depth_widths: [4], weight_widths: [4], scale: 1, start: 2, consistency: 1}}"
)
SMALL = (
    "bench=skip",
    f"bench.base={{n: {N}, device: cpu, threads: 1}}",
    "bench.rigs.cone.n_views=2",
    "bench.rigs.dome.n_views=2",
    "bench.rigs.dcspect80.pixels=6",
    "+bench.rigs.dcspect80.rows=[1]",
    "+bench.rigs.dcspect80.columns=[3, 12]",
    "~bench.cross_view",
    f"+bench.cross_view={MODEL}",
    "bench.repeats=2",
)
TINY = (
    *SMALL,
    *(f"~bench.scenes.{name}" for name in ("ventricle", "torso35", "torso80")),
    "bench.scenes.derenzo.rigs=[dcspect80]",
    "bench.scenes.head_neck.rigs=[dome]",
    "bench.scenes.full.rigs=[cone]",
    "bench.tasks.forward_static=[siddon]",
    "bench.tasks.adjoint=[joseph]",
    "bench.tasks.sirt20=[joseph]",
)
MODES = ["off", "cropped", "auto", "box", "brick"]


@pytest.fixture(scope="module")
def run(tmp_path_factory, call):
    folder = tmp_path_factory.mktemp("bench") / "skip"
    return folder, call(folder, *TINY)


def test_every_case_has_a_row_for_every_mode(run):
    _, rows = run
    assert {row["status"] for row in rows} == {"ok"}
    cases = {(row["scene"], row["rig"], row["method"], row["task"]): [] for row in rows}
    for row in rows:
        cases[row["scene"], row["rig"], row["method"], row["task"]].append(row["mode"])
    models = [modes for (*_, task), modes in cases.items() if task == "cross_view"]
    assert models == [["off", "cropped", "auto", "hull"]] * 3
    others = {case: modes for case, modes in cases.items() if case[3] != "cross_view"}
    assert set(map(tuple, others.values())) == {tuple(MODES)} and len(others) == 3 * 5
    assert {task for *_, task in others} == set(TASKS)


def test_every_figure_is_there(run):
    _, rows = run
    for row in rows:
        assert float(row["ms"]) > 0 and int(row["calls"]) >= 2 and float(row["peak_mb"]) >= 0
        assert 0 < float(row["occupancy"]) <= float(row["box"]) <= 1
        builds = row["task"] != "forward" and row["mode"] not in ("off", "cropped")
        assert (row["build_ms"] != "") == builds and row["chosen"]
        assert (row["support"] != "") == (row["task"] in ("sirt20", "cross_view"))
    assert {row["source"] for row in rows} >= {
        "derenzo",
        "body of 9%",
        "random values in 0.5 .. 1.5",
    }


def test_times_are_compared_with_both_that_skip_nothing(run):
    _, rows = run
    of = {tuple(row[k] for k in ("scene", "rig", "method", "task", "mode")): row for row in rows}
    for (*case, mode), row in of.items():
        off, cropped = of[*case, "off"], of[*case, "cropped"]
        assert float(row["over_full"]) == pytest.approx(
            float(off["ms"]) / float(row["ms"]), rel=1e-4
        )
        assert float(row["over_crop"]) == pytest.approx(
            float(cropped["ms"]) / float(row["ms"]), rel=1e-4
        )
        assert mode != "off" or float(row["over_full"]) == 1


def test_skipping_is_exact(run):
    _, rows = run
    exact = [row for row in rows if row["task"].startswith("forward") and row["mode"] != "cropped"]
    assert exact and all(row["error"] == row["differing"] == "0" for row in exact)
    for row in (
        rows
    ):  # sums in another order, or about another centre: 1e-5 of what the longest ray can hold
        if row["task"] != "cross_view":
            assert float(row["error"]) < 1e-5 * 1.5 * 512 * 3**0.5


def test_the_report_tells_all_and_where_skipping_loses(run):
    folder, rows = run
    names = {path.name for path in folder.iterdir()}
    assert {"results.csv", "table.md", "targets.md", "speedups.png", "versions.txt"} <= names
    table = (folder / "table.md").read_text()
    assert all(f"| {name} | " in table for name in rows[0]) and all(
        f"## {task}" in table for task in TASKS
    )
    for over, title in skip_report.AGAINST.items():
        shown = table.split(f"## Where skipping loses {title}")[1].split("##")[0]
        lost = [row for row in rows if row["mode"] not in MODES[:2] and float(row[over]) < 1]
        assert shown.count("\n|") == (len(lost) + 2 if lost else 0)
    assert (
        "| derenzo, adjoint: time / off's on the full cube |" in (folder / "targets.md").read_text()
    )


@pytest.fixture
def no_plots(monkeypatch):
    """Only the run whose plots a test looks for draws."""
    monkeypatch.setattr(plots, "speedups", lambda *_: None)


def test_a_restart_measures_only_what_is_missing(run, call, no_plots):
    folder, rows = run
    text = (folder / "results.csv").read_text()
    lines = text.splitlines(keepends=True)
    gone = next(
        n for n, row in enumerate(rows, 1) if row["mode"] == "box" and row["task"] == "adjoint"
    )
    (folder / "results.csv").write_text("".join(lines[:gone] + lines[gone + 1 :]))
    again = call(folder, *TINY)
    assert len(again) == len(rows) and again[:-1] == rows[: gone - 1] + rows[gone:]
    assert again[-1]["mode"] == "box" and float(again[-1]["over_full"]) > 0
    assert call(folder, *TINY) == again


def test_what_does_not_work_is_a_row_with_its_reason(tmp_path, call, no_plots):
    scenes = "{gone: {volume: {name: hdf5, path: nowhere.h5}, rigs: [cone]}}"
    options = (
        "~bench.scenes",
        f"+bench.scenes={scenes}",
        "~bench.tasks",
        "+bench.tasks={forward: [joseph]}",
        "bench.cross_view=null",
    )
    rows = call(tmp_path, *SMALL[:-3], *options)
    assert len(rows) == len(MODES)
    assert all(row["status"].startswith("skipped: FileNotFoundError: nowhere.h5") for row in rows)
    assert "nowhere.h5" in (tmp_path / "table.md").read_text()


@pytest.fixture
def trained(tmp_path):
    """A checkpoint with a grid and a rig of its own."""
    geometry = {
        "grid": {"shape": [8, 12, 12], "spacing": 12.0},
        "camera": {
            "name": "circular",
            "n_views": 3,
            "sid": 600.0,
            "sdd": 900.0,
            "detector": {"pixels": 12, "pixel_mm": 18.0},
        },
        "projector": {"name": "drr"},
    }
    method = {"name": "cross_view", "widths": [4, 8], "depth_widths": [4], "scale": 1, "start": 2}
    module = ReconstructionModule(geometry, method, {}, {"name": "adamw"}, 1.0)
    path = tmp_path / "cross_view.ckpt"
    known = {
        "state_dict": module.state_dict(),
        "hyper_parameters": dict(module.hparams),
        "callbacks": {},
    }
    torch.save(
        {**known, "global_step": 0, "pytorch-lightning_version": lightning.__version__}, path
    )
    return path


def test_a_trained_model_brings_its_grid_and_is_scored(tmp_path, trained, call, no_plots):
    options = (
        "~bench.scenes",
        "+bench.scenes={heart: {volume: {name: ventricle, field: 0.48}, rigs: [cone]}}",
    )
    rows = call(
        tmp_path / "run",
        *SMALL,
        *options,
        "~bench.tasks",
        "+bench.tasks={}",
        f"bench.cross_view.checkpoints.heart={trained}",
    )
    assert [row["status"] for row in rows] == ["ok"] * 4, rows
    assert {(row["rig"], row["grid"], row["views"], row["n"]) for row in rows} == {
        ("trained", "8x12x12", "3x12x12", "")
    }
    assert all(5 < float(row["psnr"]) < 60 for row in rows)
    for row in rows:
        assert float(row["psnr_loss"]) == pytest.approx(
            float(rows[0]["psnr"]) - float(row["psnr"]), abs=1e-3
        )
    assert rows[0]["psnr_loss"] == "0"


def test_the_shipped_settings_are_those_of_the_code():
    bench = BENCHES.from_config(compose("bench=skip", config_name="bench")["bench"])
    rows = [job.row for group in bench.groups() for job in group]
    assert rows and set(rows[0]) <= set(bench.columns) and set(bench.keys) == set(rows[0])
    assert len({tuple(str(row[key]) for key in bench.keys) for row in rows}) == len(rows)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": {"fly": ["joseph"]}}, "Unknown task fly"),
        ({"scenes": {"a": {"rigs": ["moon"]}}}, "Unknown rig moon"),
        ({"cross_view": {"checkpoints": {"b": "x"}}}, "Unknown scene b"),
    ],
)
def test_what_is_not_known_is_refused(changes, message):
    settings = {
        "scenes": {},
        "rigs": {},
        "tasks": {},
        "modes": [],
        "base": {"n": 8, "device": "cpu", "threads": 1},
    }
    with pytest.raises(ValueError, match=message):
        BENCHES.build("skip", **{**settings, **changes})
