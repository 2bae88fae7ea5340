"""Runs beside each other: paired intervals, tables that other programs read, and a Pareto front."""

import csv
import io
import json
import math
import xml.etree.ElementTree as ET

import pytest
import yaml

from mvrecon.apps import compare
from mvrecon.core.files.checks import Refused
from mvrecon.report import comparison
from mvrecon.report.comparison import COMPARED_FIGURES, mean_interval, read, t_quantile

#: PSNR of two methods on four patients of very different difficulty.
EASY, BETTER = [20.0, 25.0, 30.0, 35.0], [20.9, 26.1, 31.0, 36.0]


def run(folder, settings, scenes=("pt_0", "pt_1", "pt_2", "pt_3"), truths=None, **methods):
    """A finished run's folder: method -> (PSNR of each scene, ms); `truths` are numbers by which a
    table recognises each scene, which tables of earlier versions do not have.
    """
    rows = {
        label: {
            "parameters": 7,
            "train_seconds": 2.0,
            "ms_per_volume": ms,
            "peak_mb": None,
            **{figure: {"values": values} for figure in COMPARED_FIGURES},
        }
        for label, (values, ms) in methods.items()
    }
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    table = {"scenes": list(scenes), "methods": rows}
    if truths is not None:
        table |= {"truths": [[t, 2 * t] for t in truths], "grid": settings.get("grid")}
    (folder / "results.json").write_text(json.dumps(table))
    return folder


@pytest.fixture
def sweep(tmp_path):
    """A sweep of two runs that differ in their model and the number of views."""
    for name, views, values, ms in (("ours", 8, BETTER, 9.0), ("unet", 4, EASY, 3.0)):
        settings = {
            "name": "sweep",
            "method": {"name": name, "width": views},
            "camera": {"n_views": views, "sid": 400.0},
        }
        run(tmp_path / name, settings, **{name: (values, ms), "sirt": (EASY, 100.0)})
    return tmp_path


@pytest.mark.parametrize(
    ("freedom", "value"), [(1, 12.7062), (2, 4.3027), (7, 2.3646), (32, 2.0369), (200, 1.9719)]
)
def test_student_quantiles_match_the_tables(freedom, value):
    assert t_quantile(0.95, freedom) == pytest.approx(value, abs=5e-5)


def test_a_paired_interval_is_independent_of_differences_between_patients(sweep):
    rows = {row.method: row for row in read([sweep])}
    paired = comparison.difference(rows["ours"], rows["unet"], "psnr")
    assert paired.mean == pytest.approx(1.0) and paired.low > 0.8 and paired.high < 1.2
    alone = mean_interval(BETTER)
    assert alone.high - alone.low > 20 * (paired.high - paired.low)
    assert all(math.isnan(v) for v in mean_interval([1.0, math.nan])[1:]), "one patient"


def test_runs_are_named_by_what_differs(sweep):
    names = {row.run for row in read([sweep])}
    assert names == {"method=ours, camera.n_views=8", "method=unet, camera.n_views=4"}
    assert {row.run for row in read([sweep / "ours"])} == {"ours"}


def test_runs_of_a_sweep_have_its_names_and_numbers_for_long_values(tmp_path):
    for k, name in enumerate(("method=small", "method=unet", "method=small,++views=4")):
        model = {"name": "cross_view", "rounds": [{"widths": [8 << (k % 2)], "resolution": "half"}]}
        run(tmp_path / name, {"method": model, "views": k // 2}, cross_view=(EASY, 1.0))
    names = [row.run for row in read([tmp_path])]
    assert names == ["method=small", "method=small,views=4", "method=unet"]
    (tmp_path / "method=small").rename(tmp_path / "first")
    names = {row.run for row in read([tmp_path])}
    texts = ["method.rounds=#1, views=0", "method.rounds=#1, views=1", "method.rounds=#2, views=0"]
    assert names == set(texts)


def test_runs_that_would_have_one_name_are_told_apart_by_their_folders(tmp_path):
    """Repeated runs in several folders, and runs that differ in more settings than a name holds."""
    for site in "ab":
        run(tmp_path / site / "run", {"name": "x", "seed": 0}, sirt=(EASY, 1.0))
    names = [row.run for row in read([tmp_path])]
    assert names == [f"run ({tmp_path / site / 'run'})" for site in "ab"]
    for seed in (1, 2):
        options = dict.fromkeys("pqrs", 1) | {"seed": seed}
        run(tmp_path / f"c{seed}", {"name": "x", **options}, sirt=(EASY, 1.0))
    names = [row.run for row in read([tmp_path])]
    assert len(set(names)) == 4, names


def test_every_format_of_the_table_contains_every_method(sweep, tmp_path):
    out = tmp_path / "table"
    compare.compare([sweep], reference="unet", out=out)
    lines = list(csv.DictReader(io.StringIO((out / "compare.csv").read_text())))
    assert [line["method"] for line in lines] == ["ours", "sirt", "unet", "sirt"]
    assert float(lines[0]["psnr mean"]) == pytest.approx(sum(BETTER) / 4)
    assert float(lines[0]["psnr difference"]) == pytest.approx(1.0)
    page, paper = ((out / f"compare.{end}").read_text() for end in ("md", "tex"))
    assert page.count("\n") == 6 and "+1.00 (+0.87 to +1.13)" in page
    assert r"camera.n\_views=8" in paper and paper.count(r"\\") == 5
    drawn = ET.fromstring((out / "pareto.svg").read_text()).iter()
    assert sum(element.get("id", "").startswith("method") for element in drawn) == 4


def test_the_pareto_front_omits_dominated_methods(sweep):
    front = comparison.front(read([sweep]), "psnr")
    assert [row.method for row in front] == ["unet", "ours"]


def test_a_method_that_failed_in_a_scene_is_never_ranked(tmp_path):
    """Its figures over the other, easy scenes would be best."""
    spoilt = [None, None, 35.0, 40.0]
    folder = run(tmp_path / "a", {}, sirt=(EASY, 2.0), ours=(BETTER, 3.0), net=(spoilt, 1.0))
    net = read([folder])[2]
    assert net.failed == 2 and math.isnan(net.mean("psnr"))
    head, body = compare.compare([folder], out=tmp_path / "out")
    rows = [dict(zip(head, line, strict=True)) for line in body]
    assert [row["PSNR dB"] for row in rows] == ["27.50", "28.50", "2 of 4 failed"]
    assert rows[2]["psnr - reference (95 %)"] == "-"
    lines = list(csv.DictReader(io.StringIO((tmp_path / "out" / "compare.csv").read_text())))
    assert [line["failed"] for line in lines] == ["0", "0", "2"]
    assert lines[2]["psnr mean"] == lines[2]["psnr difference"] == "nan"
    assert [row.method for row in comparison.front(read([folder]), "psnr")] == ["sirt", "ours"]
    assert ">net<" not in (svg := (tmp_path / "out" / "pareto.svg").read_text()) and ">ours<" in svg


def test_equal_volumes_have_infinite_psnr_not_missing(tmp_path):
    exact = ["inf", 26.1, 31.0, 36.0]
    folder = run(tmp_path / "a", {}, sirt=(EASY, 2.0), exact=(exact, 1.0), twin=(exact, 3.0))
    sirt, one, two = read([folder])
    assert one.mean("psnr") == math.inf and one.failed == 0
    assert comparison.difference(one, sirt, "psnr").mean == math.inf
    assert comparison.difference(sirt, one, "psnr").mean == -math.inf
    assert comparison.difference(two, one, "psnr") == (0.0, 0.0, 0.0)
    assert [row.method for row in comparison.front([sirt, one, two], "psnr")] == ["exact"]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_tables_without_a_finite_figure_are_written_with_an_empty_picture(value, tmp_path):
    """Of methods that all failed, or whose volumes all equal the truth."""
    run(tmp_path / "run", {}, net=([value] * 4, 3.0), sirt=([value] * 4, None))
    compare.compare([tmp_path / "run"], out=tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*compare.TABLE_FILES}
    assert ">net<" not in (tmp_path / "out" / "pareto.svg").read_text()


def test_a_foreign_table_is_refused_or_only_shown(tmp_path, capsys):
    """A file of results that is damaged is refused by name, and one with markup in a label shows it
    as text.
    """
    folder = run(tmp_path / "a", {}, **{"<b>[red]$x": (EASY, 1.0)})
    compare.show(compare.compare([folder], out=tmp_path / "out"))
    assert "<b>[red]$x" in capsys.readouterr().out
    assert "<b>" not in (tmp_path / "out" / "pareto.svg").read_text()
    (folder / "results.json").write_text('{"methods": {"a": 3}}')
    with pytest.raises(Refused, match="results.json: is no table of results"):
        read([folder])
    (folder / "results.json").write_text('{"scenes": [], "methods": {}}')
    with pytest.raises(Refused, match="expected tables of methods, got none"):
        compare.compare([folder])
    with pytest.raises(FileNotFoundError, match="Expected a finished run"):
        read([tmp_path / "out"])


#: Patients of two sites, the first two of one name; another order of them; and half a dB more.
SITES, TURNED = ("p1", "p1", "p2", "p3"), [1, 0, 2, 3]
MORE = [value + 0.5 for value in EASY]


def turned(values):
    return [values[k] for k in TURNED]


def paired(one, other):
    """The mean difference in PSNR of the first run's method to the second's."""
    return comparison.difference(read([one])[0], read([other])[0], "psnr").mean


def test_patients_of_one_name_are_paired_with_themselves(tmp_path):
    """+0.5 dB in every case is +0.5 dB on average: in one table, with its scenes in another order
    or in part, and in tables of an earlier version with the same test scenes.
    """
    both = run(tmp_path / "both", {}, SITES, ours=(MORE, 1.0), sirt=(EASY, 1.0))
    ours, sirt = read([both])
    assert comparison.difference(ours, sirt, "psnr").mean == pytest.approx(0.5)
    assert paired(both, run(tmp_path / "old", {}, SITES, sirt=(EASY, 1.0))) == pytest.approx(0.5)
    new = run(tmp_path / "new", {}, SITES, [1, 2, 3, 4], ours=(MORE, 1.0))
    other = run(
        tmp_path / "other", {"data": 1}, SITES, turned([1, 2, 3, 4]), sirt=(turned(EASY), 1.0)
    )
    part = run(tmp_path / "part", {"data": 2}, SITES[1:], [2, 3, 4], sirt=(EASY[1:], 1.0))
    assert paired(new, other) == paired(other, new) * -1 == pytest.approx(0.5)
    assert paired(new, part) == pytest.approx(0.5)
    rounded = run(tmp_path / "r", {}, SITES, [1.000001, 2, 3, 4], sirt=(EASY, 1.0))
    assert paired(new, rounded) == pytest.approx(0.5), "as on another machine"


def test_different_patients_of_one_name_are_not_paired(tmp_path):
    """Two sites, each with patients pt_0 to pt_3; on grids that differ, names decide, if every
    scene has its own and the settings of the scenes do not differ: by their path, their part, or
    those of the test alone.
    """
    first = run(tmp_path / "a", {}, truths=[1, 2, 3, 4], ours=(MORE, 1.0))
    second = run(tmp_path / "b", {"scene": "b"}, truths=[5, 6, 7, 8], sirt=(EASY, 1.0))
    assert math.isnan(paired(first, second))
    finer = run(tmp_path / "c", {"grid": 2}, truths=[5, 6, 7, 8], sirt=(EASY, 1.0))
    assert paired(first, finer) == pytest.approx(0.5)
    for k, scenes in enumerate(
        (
            {"scene": "c"},
            {"scene": {"name": "volumes", "path": "c"}},
            {"scene": "b", "test_scene": {"name": "volumes", "path": "c"}},
        )
    ):
        other = run(
            tmp_path / f"d{k}", {"grid": 2, **scenes}, truths=[1, 2, 3, 4], sirt=(EASY, 1.0)
        )
        assert math.isnan(paired(second, other)) and paired(first, other) == pytest.approx(0.5)
    more = {"grid": 2, "scene": "b", "data": 9}
    assert paired(second, run(tmp_path / "e", more, truths=[1, 2, 3, 4], sirt=(MORE, 1.0))) < 0


def test_tables_state_their_test_scenes_themselves(tmp_path):
    """Evaluations, whose settings do not have the scene of their run, on grids that differ: equal
    names of two sites are not paired, those of one site are. Also tried: a training beside an
    evaluation of it, and of another.
    """
    runs = {}
    for name, site, grid in (("a", "A", 1), ("b", "B", 2), ("c", "A", 2)):
        settings = {"checkpoint": f"runs/{name}", "test_scene": None, "grid": grid}
        runs[name] = run(tmp_path / name, settings, truths=[1, 2, 3, 4], ours=(MORE, 1.0))
        (runs[name] / "config.yaml").rename(runs[name] / "eval.yaml")
        table = json.loads((runs[name] / "results.json").read_text())
        table["scene"] = {"name": "volumes", "path": site}
        (runs[name] / "results.json").write_text(json.dumps(table))
    assert math.isnan(paired(runs["a"], runs["b"])) and paired(runs["a"], runs["c"]) == 0.0


def test_figures_of_different_data_ranges_are_not_subtracted(tmp_path):
    """The same cases with `test_scene.data_range` of 0.02 and 0.04: PSNR differs by 6.02 dB without
    any difference of the volumes. Ranges that round differently, or are not known, are paired.
    """
    tables = {}
    for name, data_range in (("a", 0.02), ("b", 0.04), ("c", 0.02 * (1 + 1e-12)), ("old", None)):
        folder = run(tmp_path / name, {}, truths=[1, 2, 3, 4], ours=(EASY, 1.0))
        table = json.loads((folder / "results.json").read_text())
        if data_range is not None:
            table["data_range"] = data_range
        (folder / "results.json").write_text(json.dumps(table))
        (tables[name],) = read([folder])
    for one, other, pairs in (("a", "b", 0), ("b", "a", 0), ("a", "c", 4), ("a", "old", 4)):
        assert len(comparison.common_scenes(tables[one], tables[other])) == pairs
    assert math.isnan(comparison.difference(tables["a"], tables["b"], "psnr").mean)


@pytest.mark.parametrize("values", ["psnr", "truths", "scenes"])
@pytest.mark.parametrize("count", [3, 5])
def test_a_table_with_other_numbers_of_values_than_scenes_is_refused(tmp_path, values, count):
    """More values would shift the mean without a word."""
    folder = run(tmp_path / "a", {}, truths=[1, 2, 3, 4], ours=(EASY, 1.0))
    table = json.loads((folder / "results.json").read_text())
    holder = {"psnr": table["methods"]["ours"]["psnr"]}.get(values, table)
    key = "values" if values == "psnr" else values
    holder[key] = [*holder[key], *holder[key]][:count]
    (folder / "results.json").write_text(json.dumps(table))
    with pytest.raises(Refused, match="expected a value for each scene"):
        read([folder])


def test_tables_that_cannot_tell_patients_apart_are_refused(tmp_path, capsys):
    old = run(tmp_path / "a", {}, SITES, ours=(MORE, 1.0))
    for name, settings, scenes, values in (
        ("b", {"scene": {"path": "b"}}, SITES, EASY),
        ("c", {}, SITES[1:], EASY[1:]),
    ):
        other = run(tmp_path / name, settings, scenes, sirt=(values, 1.0))
        with pytest.raises(SystemExit):
            compare.main([str(old), str(other)])
        assert "several test scenes are named 'p1'" in capsys.readouterr().err


@pytest.mark.parametrize("expected", ["a file, got a folder", "a folder, got a file"])
def test_a_table_that_cannot_be_written_whole_is_not_begun(sweep, tmp_path, expected):
    out = tmp_path / "table"
    if expected == "a file, got a folder":
        (out / "compare.csv").mkdir(parents=True)
    else:
        out.write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OSError, match=f"expected {expected}"):
        compare.compare([sweep], out=out)
    assert sorted(tmp_path.rglob("*")) == before
