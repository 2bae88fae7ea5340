"""`mvrecon-bench bench=skip` on sizes that take seconds."""

import pytest

from mvrecon_bench.bench import BENCHES
from mvrecon_bench.benchmarks import plots
from mvrecon_bench.benchmarks.skip import TASKS

N = 12
SMALL = (
    "bench=skip",
    f"bench.base={{n: {N}, device: cpu, threads: 1}}",
    "bench.rigs.cone.n_views=2",
    "bench.rigs.dome.n_views=2",
    "bench.rigs.dcspect80.pixels=6",
    "+bench.rigs.dcspect80.rows=[1]",
    "+bench.rigs.dcspect80.columns=[3, 12]",
    "bench.repeats=2",
)
TINY = (
    *SMALL,
    *(f"~bench.scenes.{name}" for name in ("ventricle", "torso35", "torso80")),
    "bench.scenes.derenzo.rigs=[dcspect80]",
    "bench.scenes.head_neck.rigs=[dome]",
    "bench.scenes.full.rigs=[cone]",
    "bench.tasks.forward=[joseph]",
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
    assert set(map(tuple, cases.values())) == {tuple(MODES)} and len(cases) == 3 * 4
    assert {task for *_, task in cases} == set(TASKS)


def test_every_figure_is_there(run):
    _, rows = run
    for row in rows:
        assert float(row["ms"]) > 0 and int(row["calls"]) >= 2 and float(row["peak_mb"]) >= 0
        assert 0 < float(row["occupancy"]) <= float(row["box"]) <= 1
        builds = row["task"] != "forward" and row["mode"] not in ("off", "cropped")
        assert (row["build_ms"] != "") == builds and row["chosen"]
        assert (row["support"] != "") == (row["task"] == "sirt20")
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
    for row in rows:  # sums in another order, or about another centre: 1e-5 of the longest ray
        assert float(row["error"]) < 1e-5 * 1.5 * 512 * 3**0.5


def test_the_report_tells_all(run):
    folder, rows = run
    names = {path.name for path in folder.iterdir()}
    assert {"results.csv", "table.md", "speedups.png", "versions.txt"} <= names
    table = (folder / "table.md").read_text()
    assert all(f"| {name} | " in table for name in rows[0])
    assert all(f"## task {task}" in table for task in TASKS)


@pytest.fixture
def no_plots(monkeypatch):
    """Only the run whose plots a test looks for draws."""
    monkeypatch.setattr(plots, "speedups", lambda *_: None)


def test_what_does_not_work_is_a_row_with_its_reason(tmp_path, call, no_plots):
    scenes = "{gone: {volume: {name: hdf5, path: nowhere.h5}, rigs: [cone]}}"
    options = (
        "~bench.scenes",
        f"+bench.scenes={scenes}",
        "~bench.tasks",
        "+bench.tasks={forward: [joseph]}",
    )
    rows = call(tmp_path, *SMALL, *options)
    assert len(rows) == len(MODES)
    assert all(row["status"].startswith("skipped: FileNotFoundError: nowhere.h5") for row in rows)
    assert "nowhere.h5" in (tmp_path / "table.md").read_text()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": {"fly": ["joseph"]}}, "task must be one of forward.*got 'fly'"),
        ({"scenes": {"a": {"rigs": ["moon"]}}}, "rig must be one of .*got 'moon'"),
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
