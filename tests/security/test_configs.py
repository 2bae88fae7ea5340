"""A config is a list of names and numbers: whatever it says, nothing runs, nothing is written,
nothing is read.
"""

import sys
from functools import partial
from pathlib import Path

import pytest
import torch

import mvrecon.apps.simulate
import mvrecon.apps.train
from mvrecon.apps.config import compose, launch
from mvrecon.apps.settings import TrainSettings
from mvrecon.core.files.checks import Refused, yaml_of
from mvrecon.core.options import check
from mvrecon.core.registry import import_plugins
from mvrecon.training.targets import instantiate
from tests.faults.hostile import BOMB, WAYS_OUT, Payload, experiment, experiments, targets
from tests.training.runs import call


@pytest.fixture
def sentinel(tmp_path: Path) -> Path:
    """A file that only a hostile sample makes."""
    return tmp_path / "sentinel"


@pytest.mark.parametrize("name", sorted(targets(Path("sentinel"))))
def test_a_target_is_a_callback_or_a_logger_or_refused(name: str, sentinel: Path):
    """A target in a config is a callback or a logger of Lightning or mvrecon, or it is refused and
    does not run.
    """
    torch.save(Payload(f"touch {sentinel}"), sentinel.with_name("payload.ckpt"))
    with pytest.raises(PermissionError, match="not allowed; expected"):
        instantiate(targets(sentinel)[name], sentinel.parent)
    assert not sentinel.exists()


def test_an_alias_or_a_reference_to_a_target_is_what_it_names(sentinel: Path, folder):
    """A target by an alias or a reference is judged by what it names."""
    text = f"""
optimizer: {{a: &t os.system, b: touch {sentinel}}}
callbacks:
  by_alias: {{_target_: *t, command: touch {sentinel}}}
  by_reference: {{_target_: "${{optimizer.a}}", command: touch {sentinel}}}"""
    settings = compose(*folder(text))
    for name in ("by_alias", "by_reference"):
        assert settings["callbacks"][name]["_target_"] == "os.system"
        with pytest.raises(PermissionError, match="'os.system' is not allowed"):
            instantiate(settings["callbacks"][name], sentinel.parent)
    assert not sentinel.exists()


@pytest.fixture
def folder(tmp_path: Path):
    """An experiment in a folder that was fetched from somewhere; returns the overrides that choose
    it.
    """

    return partial(experiment, tmp_path)


@pytest.mark.parametrize("name", sorted(experiments(Path("sentinel"))))
def test_a_fetched_experiment_tells_hydra_nothing(name: str, sentinel: Path, folder):
    """A fetched experiment that sets callbacks, launchers, log files or folders of Hydra is
    refused.
    """
    with pytest.raises(PermissionError, match=r"A config sets \['hydra\..*only a command line may"):
        compose(*folder(experiments(sentinel)[name]))


def test_the_app_refuses_before_hydra_acts(sentinel: Path, folder, tmp_path: Path, capsys):
    """A fetched experiment is refused before Hydra makes a folder or runs a callback."""
    folder(experiments(sentinel)["a callback"])
    command = (f"--config-dir={tmp_path}", "experiment=evil", "cases=[0]")
    assert call(mvrecon.apps.simulate, *command, f"hydra.run.dir={tmp_path}/out") == 1
    assert "only a command line may" in capsys.readouterr().err
    assert not sentinel.exists() and not (tmp_path / "out").exists()


def test_configs_of_hydras_own_in_a_fetched_folder_are_refused(folder):
    """A fetched folder with configs of Hydra's own is refused."""
    chosen = folder("name: mine", **{"hydra/launcher/evil.yaml": "_target_: os.system"})
    with pytest.raises(PermissionError, match="configs of Hydra's own"):
        compose(*chosen, "hydra/launcher=evil")


def test_environment_variables_are_not_read(folder, monkeypatch: pytest.MonkeyPatch):
    """A fetched experiment does not read environment variables."""
    monkeypatch.setenv("SECRET", "s3cret")
    with pytest.raises(PermissionError, match="environment variables"):
        compose(*folder("name: ${oc.env:SECRET}"))
    assert compose("name=${oc.env:SECRET}")["name"] == "s3cret"  # the user's own word


@pytest.mark.parametrize("name", WAYS_OUT)
def test_a_name_does_not_lead_out_of_the_outputs(name: str, folder):
    """The name of an experiment never leads out of the folder of outputs."""
    with pytest.raises(Refused, match="has the name"):
        compose(*folder(f"name: {name!r}"))


@pytest.mark.parametrize(
    ("text", "error"), [("out: {}", PermissionError), ("bench: {{name: ../..{}}}", Refused)]
)
def test_a_fetched_benchmark_does_not_choose_its_folder(text: str, error: type, tmp_path: Path):
    """The folder of a benchmark is chosen by the command line, and not by a config that was
    fetched.
    """
    files = {"bench/evil.yaml": f"# @package _global_\n{text.format(tmp_path / 'x')}\n"}
    place = experiment(tmp_path, "name: mine", **files)[0]
    with pytest.raises(error, match=r"sets \['out'\]; only a command line may|has the name '\.\.'"):
        compose(place, "bench=evil", config_name="bench")


def test_a_yaml_file_that_unfolds_is_refused_at_once(folder, tmp_path: Path):
    """A YAML file whose aliases unfold to more than 100,000 values is refused."""
    with pytest.raises(Refused, match=r"evil\.yaml: unfolds to more than"):
        compose(*folder(BOMB))
    path = tmp_path / "bomb.yaml"
    for text, message in [
        (BOMB, "unfolds"),
        ("a: &a [*a]", "unfolds"),
        ("x: " + "[" * 10_000, "is not YAML"),
    ]:
        path.write_text(text)
        with pytest.raises(Refused, match=rf"bomb\.yaml: {message}"):
            yaml_of(path)


def test_yaml_tags_build_nothing(sentinel: Path, folder):
    """A tag in a YAML file builds nothing."""
    for tag in (f'!!python/object/apply:os.system ["touch {sentinel}"]', "!!python/name:os.system"):
        with pytest.raises(Exception, match="could not determine a constructor|is not YAML"):
            compose(*folder(f"name: {tag}"))
    assert not sentinel.exists()


@pytest.mark.parametrize(
    "module", ["os", "antigravity", "lightning.pytorch.cli", "evil", "a b", ".x"]
)
def test_a_setting_imports_only_what_was_written_for_mvrecon(
    module: str, tmp_path: Path, monkeypatch, sentinel: Path
):
    """The setting `plugins` imports only modules whose own source imports mvrecon."""
    (tmp_path / "evil.py").write_text(f"open({str(sentinel)!r}, 'w')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(
        PermissionError, match="expected a module on Python's path whose own source imports mvrecon"
    ):
        import_plugins([module])
    assert not sentinel.exists()


def test_a_pickled_config_is_not_run_again(capsys):
    """A pickled config is not run again."""
    assert call(mvrecon.apps.train, "--experimental-rerun=a.pickle") == 1
    assert "unpickles a file" in capsys.readouterr().err


def test_a_settings_file_of_a_gigabyte_is_not_read(tmp_path: Path):
    """A settings file of a gigabyte is refused without reading it."""
    with (tmp_path / "evil.yaml").open("wb") as file:
        file.truncate(2**30)  # a hole: a gigabyte on no disk
    with pytest.raises(Refused, match=r"evil\.yaml: is larger than"):
        yaml_of(tmp_path / "evil.yaml")


@pytest.mark.parametrize(
    "text",
    ["{hydra.job.env_set.A: '1,2'}", "{hydra/job_logging: none}", "{label: ../../out}", "{}"],
)
def test_a_fetched_experiment_varies_nothing(text: str, folder):
    """Nor says anything else of Hydra, before any job of a sweep is begun."""
    evil = folder(f"hydra: {{sweeper: {{params: {text}}}}}")
    with pytest.raises(PermissionError, match=r"sets \['hydra.sweepe.*only a command line"):
        compose(*evil)


def test_no_choice_of_a_sweep_sets_what_is_hydras_own(folder):
    """Every file of a fetched folder is checked, whatever a sweep chooses of it."""
    worse = {"experiment/worse.yaml": "# @package _global_\nhydra: {job: {env_set: {A: b}}}\n"}
    place, _ = folder("name: mine", **worse)
    with pytest.raises(PermissionError, match=r"A config sets .*'hydra.job.env_set.A'"):
        compose(place, "experiment=evil")


def test_a_fetched_experiment_composes_the_same_at_any_time(folder):
    """A file whose contents change between the check and the run would not have been checked."""
    for text in ("defaults: ['other_${now:%S}']", "name: '${oc.select:label,x}'"):
        with pytest.raises(PermissionError, match="calls another resolver"):
            compose(*folder(text))


def test_a_sweep_with_a_fetched_experiment_is_refused_before_hydra_acts(tmp_path: Path, capsys):
    text = "hydra: {sweeper: {params: {hydra.job.env_set.A: b}}}"
    experiment(tmp_path, text)
    place = f"hydra.sweep.dir={tmp_path}/out"
    command = ("-m", place, "experiment=evil", "--config-dir", str(tmp_path))
    assert call(mvrecon.apps.simulate, *command) == 1
    assert "only a command line may" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_fetched_folder_reads_its_own_files_only(folder, tmp_path: Path):
    """A link out of a folder, a resumed run, keys that are no texts, and choices in a circle are
    refused; also tried: pipes, folders named x.yaml, null as a key, a file that is a number.
    """
    for text in ("resume: run", "3: 1"):
        with pytest.raises(PermissionError, match="only a command line may|texts as keys"):
            compose(*folder(text))
    with pytest.raises(LookupError, match="circle"):
        compose(*folder("defaults: [/experiment: evil]"))
    outside = tmp_path.with_suffix(".yaml")
    outside.write_text("name: mine\n")
    (tmp_path / "experiment/evil.yaml").unlink()
    (tmp_path / "experiment/evil.yaml").symlink_to(outside)
    with pytest.raises(PermissionError, match="got a link"):
        compose(f"--config-dir={tmp_path}", "experiment=evil")


def test_fetched_folders_of_one_name_are_refused(folder, tmp_path: Path):
    """Of two experiments of one name the last would win."""
    again = tmp_path / "again"
    options = folder("seed: 1")
    with pytest.raises(PermissionError, match="evil.yaml: .*evil.yaml has this name"):
        compose(*options, *experiment(again, "seed: 2")[:1])


def test_a_fetched_part_sets_its_own_options_only(folder, tmp_path: Path):
    """Its option `out` is harmless, unless all settings take its place; in `trainer` it sets
    nothing that the app does.
    """
    (tmp_path / "head").mkdir()
    (tmp_path / "head/mine.yaml").write_text("name: density\nout: ../../out\n")
    chosen = "{defaults: [/head@method.head: mine]}"
    assert compose(*folder(chosen))["method"]["head"] == {"name": "density", "out": "../../out"}
    for package in ("_global_", "_here_", ""):
        with pytest.raises(PermissionError, match="only a command line may"):
            compose(*folder(f"{{defaults: ['/head@{package}': mine]}}"))
    for option in ("logger", "callbacks", "default_root_dir", "plugins"):
        settings = {"trainer": {option: "evil"}}
        with pytest.raises(TypeError, match=f"trainer.{option}: expected null, got 'evil'"):
            check(settings, TrainSettings)


@pytest.mark.parametrize("sweeps", [[], ["-m"]])
def test_no_name_by_reference_leads_out_of_the_outputs(sweeps, tmp_path, monkeypatch, capsys):
    """Of a run or a sweep: nothing is made outside, nor in the folder of outputs."""
    experiment(tmp_path / "fetched", "name: ${label}\nlabel: ../../out")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    chosen = [f"--config-dir={tmp_path}/fetched", "experiment=evil", *sweeps]
    monkeypatch.setattr(sys, "argv", ["mvrecon-train", *chosen])
    with pytest.raises(SystemExit):
        launch(lambda config: pytest.fail("the task began"), "train")
    assert "has the name '..'" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"fetched", "work"}
