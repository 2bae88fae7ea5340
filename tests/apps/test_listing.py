"""mvrecon-list reads sources: names, first lines and options equal those of an import."""

import inspect
import re
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from mvrecon.apps.list import SETTING, listed, main
from mvrecon.core import registry
from mvrecon.core.parts import LISTED, LOSSES, METRICS, REGISTRIES, describe
from mvrecon.core.signatures import REQUIRED

CATCH_ALL = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
PARTS = [(kind, name) for kind, known in REGISTRIES.items() for name in known.names()]


@pytest.mark.parametrize(("kind", "name"), PARTS)
def test_reading_sources_gives_the_same_as_importing_them(kind: str, name: str):
    part = describe(kind, name)
    imported = REGISTRIES[kind].get(name)
    assert not part.error
    signature = inspect.signature(imported).parameters
    parameters = {n: p for n, p in signature.items() if p.kind not in CATCH_ALL}
    shared = {
        option
        for p in signature.values()
        for unpacked in getattr(p.annotation, "__args__", ()) * (p.kind is p.VAR_KEYWORD)
        for option in unpacked.__annotations__
    }
    of_function = kind == "method" and not inspect.isclass(imported)
    leading = 2 if of_function else {"projector": 2, "network": 2, "weighting": 1}.get(kind, 0)
    passed = {*list(parameters)[:leading]}
    assert kind != "projector" or passed == {"grid", "cameras"}
    assert set(part.options) == {*parameters, *shared} - passed
    needed = {n for n, p in parameters.items() if p.default is p.empty}
    assert {
        n for n, option in part.options.items() if option.default is REQUIRED
    } == needed - passed
    assert part.summary
    assert [option for option, what in part.options.items() if not what.text] == []
    assert " ".join(inspect.getdoc(imported).split()).startswith(part.summary)


def test_every_part_and_origin_is_printed_and_options_with_their_units(
    capsys: pytest.CaptureFixture[str],
):
    texts = {}
    for kind in REGISTRIES:
        assert main([kind]) == 0
        texts[kind] = capsys.readouterr().out
    assert "arc_degrees=180.0  the range of angles" in texts["camera"]
    assert "sid (float > 0)  mm from the source to the axis." in texts["camera"]
    for kind, name in PARTS:
        assert name in texts[kind]
        assert REGISTRIES[kind].origin(name) in texts[kind]


def test_without_a_kind_all_names_fit_a_screen(capsys: pytest.CaptureFixture[str]):
    assert main([]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80 and text.count("\n") <= 40
    shown = " ".join(text.split())
    for kind, known in LISTED.items():
        if names := known.names():
            assert f"{kind} {', '.join(names)}" in shown


def test_the_list_imports_no_heavy_library(root):
    code = (
        "import sys; from mvrecon.apps.list import main; main([]);"
        "sys.exit(str(sorted({'torch', 'numpy', 'hydra', 'omegaconf'} & set(sys.modules)) or ''))"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert ended.stderr.strip() == ""


def test_a_single_kind_can_be_printed(capsys: pytest.CaptureFixture[str]):
    assert main(["head"]) == 0
    text = capsys.readouterr().out
    assert "softmax_depth" in text
    assert "joseph" not in text
    with pytest.raises(SystemExit):
        main(["haed"])
    assert "choose from" in capsys.readouterr().err


def test_a_single_part_can_be_printed_and_an_unknown_one_names_the_nearest(capsys):
    assert main(["projector", "drr"]) == 0
    out = capsys.readouterr().out
    assert "rays_per_pixel" in out and "radon" not in out
    with pytest.raises(SystemExit):
        main(["projector", "ddr"])
    assert "Unknown projector 'ddr'; did you mean 'drr'" in capsys.readouterr().err


def test_settings_and_named_parts_of_training_are_listed(capsys):
    def text(kind: str) -> str:
        assert main([kind]) == 0
        return " ".join(capsys.readouterr().out.split())

    assert "weight_decay=0.01" in text("optimizer")  # of AdamW, read through torch's own imports
    assert "alternations=4 number of alternations of reconstruction and" in text("setting")
    assert "acquisition" in text("setting") and "grid" in text("setting")
    assert "ItkViews" in text("views")
    with pytest.raises(SystemExit) as end:
        main(["logger"])
    assert end.value.code == 0
    assert "No logger is registered; plugins can add some." in capsys.readouterr().err


def test_no_text_of_an_option_needs_its_name():
    """Such as "of the detector" in place of "blur of the detector"."""
    texts = {
        f"{part.kind} {part.name} {name}": option.text
        for kind in (None, SETTING)
        for part in listed(kind)
        for name, option in part.options.items()
        if option.text
    }
    assert len(texts) > 300
    assert not [name for name, text in texts.items() if text.startswith(("of ", "for ", "at "))]


def test_every_metric_and_loss_is_listed_with_its_unit(tmp_path, monkeypatch, capsys):
    """Those of mvrecon, of a plugin that declares a unit, of one that does not, and of one that
    does not import.
    """
    signature = "(volume, truth, inside, data_range):"
    (tmp_path / "lengths.py").write_text(
        "from mvrecon.report.metrics import Metric\n\n\n"
        f'@Metric(unit="mm")\ndef extent{signature}\n    """Error of the size."""\n\n\n'
        f'def plain{signature}\n    """A figure as of earlier versions."""\n'
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    places = {"extent": "lengths:extent", "plain": "lengths:plain", "gone": "no_such_module:f"}
    monkeypatch.setattr(METRICS, "_parts", METRICS._parts | places)
    assert main(["metric"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for name, unit in {
        **{"psnr": "dB, higher", "psnr_inside": "dB, higher", "ssim": "1, higher"},
        **{"nrmse": "1, lower", "view_nrmse": "1, lower"},
        **{"extent": "mm, lower", "plain": "not declared, lower"},
    }.items():
        assert re.search(rf" {name} [^|]*? unit {unit} is better", text), name
    assert re.search(r" gone broken: .*no_such_module", text)
    assert main(["loss"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for name in LOSSES.names():
        if LOSSES.origin(name).startswith("mvrecon."):
            assert re.search(rf" {name} [^:]* without a unit", text), name


@pytest.mark.parametrize("kind", sorted(set(LISTED) - set(REGISTRIES)))
def test_names_beside_the_parts_are_described_without_an_error(kind: str):
    assert [p for p in (describe(kind, name) for name in LISTED[kind].names()) if p.error] == []


def test_a_plugin_that_breaks_at_import_is_named_when_checked(tmp_path, monkeypatch, capsys):
    (tmp_path / "broken_head_plugin.py").write_text(
        'class Head:\n    """Fine to read."""\n\nraise OSError("no licence")\n'
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint("head.broken", "broken_head_plugin:Head", registry.GROUP)
    monkeypatch.setattr(registry, "installed", lambda: (point,))
    assert main(["head"]) == 0
    assert "does not import: no licence" in " ".join(capsys.readouterr().out.split())
    assert main(["head", "--check"]) == 1
    text = " ".join(capsys.readouterr().out.split())
    assert "broken: The head 'broken' (broken_head_plugin:Head) does not import: no licence" in text
    assert "softmax_depth" in text and text.endswith("3 parts imported, 1 of them broken")
    assert "=" not in text  # no options: a line for each part


def test_parts_of_a_module_in_the_current_folder_are_listed(tmp_path, monkeypatch, capsys):
    (tmp_path / "local_heads.py").write_text(
        "from mvrecon.core.parts import HEADS\n\n\n"
        '@HEADS.register("local")\nclass Local:\n    """A head of this folder."""\n'
    )
    (tmp_path / "local_fault.py").write_text('import mvrecon\n\nraise ValueError("no licence")\n')
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(registry, "_IMPORTED", set())
    monkeypatch.setattr(LISTED["head"], "_parts", dict(LISTED["head"]._parts))
    monkeypatch.setattr(sys, "argv", ["mvrecon-list", "plugins=[local_heads]", "head", "local"])
    assert main() == 0
    out = capsys.readouterr().out
    assert "A head of this folder." in out and "local_heads:Local" in out
    for module, why in {
        "local_fault": "no licence; raised in .*local_fault.py, line 3 ",
        "local_none": "no such module",
    }.items():
        with pytest.raises(SystemExit) as stop:
            main([f"plugins={module}"])
        error = capsys.readouterr().err
        assert stop.value.code == 1 and error.count("\n") == 1
        assert re.match(f"mvrecon-list: .*{why}", error)


def test_missing_or_invalid_sources_are_reported(tmp_path, monkeypatch):
    (tmp_path / "half_plugin.py").write_text("def f(:\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    points = {
        "gone": "no_such_package.at.all:Head",
        "half": "half_plugin:Head",
        "hollow": "json:Nothing",
    }
    found = tuple(
        EntryPoint(f"head.{name}", value, registry.GROUP) for name, value in points.items()
    )
    monkeypatch.setattr(registry, "installed", lambda: found)
    assert "No module named 'no_such_package'" in describe("head", "gone").error
    assert "invalid syntax" in describe("head", "half").error
    assert "has no attribute 'Nothing'" in describe("head", "hollow").error
