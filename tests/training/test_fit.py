"""Training: contents of checkpoints, resuming, and dependence on seeds only."""

import copy
from dataclasses import replace

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.files.runs import folder_of_run
from mvrecon.training import checkpoints, fit, trained
from mvrecon.training.callbacks import StepProgress
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings

PLAIN = (dict, list, tuple, str, int, float, bool, type(None), torch.Tensor)


@pytest.fixture(scope="module")
def settings():
    return TrainSettings(**compose("experiment=smoke"))


@pytest.fixture(scope="module")
def data(settings):
    return fit.build_data(settings)


@pytest.fixture(scope="module")
def run(settings, data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    fit.fit("cross_view_small", settings, data, folder)
    return folder


def all_plain(value):
    if isinstance(value, dict):
        return all(all_plain(key) and all_plain(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(all_plain(item) for item in value)
    return isinstance(value, PLAIN)


def test_a_checkpoint_loads_with_torch_defaults_and_is_plain(run, settings):
    state = torch.load(checkpoints.finished(run, "cross_view_small"))
    assert state["global_step"] == settings.trainer["max_steps"]
    assert state["hyper_parameters"]["method"] == settings.method
    assert all_plain(state["hyper_parameters"]) and all_plain(state["callbacks"])


def test_a_module_is_restored_from_its_checkpoint_alone(run, data):
    path = checkpoints.finished(run, "cross_view_small")
    module = ReconstructionModule.load_from_checkpoint(path)
    again = trained.load_checkpoint(path)
    data.setup("test")
    views = next(iter(data.test_dataloader()))["views"]
    with torch.no_grad():
        assert torch.equal(module.eval()(views).volume, again.module(views).volume)
    assert again.steps == 3 and again.seconds > 0


def test_only_the_finished_checkpoint_remains(run):
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["cross_view_small.ckpt"]


def test_training_changes_the_weights_and_equal_seeds_give_equal_weights(
    run, settings, data, tmp_path
):
    fit.fit("cross_view_small", settings, data, tmp_path)
    first, second = (
        trained.load_checkpoint(checkpoints.finished(f, "cross_view_small")).module
        for f in (run, tmp_path)
    )
    torch.manual_seed(settings.seed)
    other = copy.deepcopy(settings)
    other.seed = 1
    fit.fit("cross_view_small", other, data, tmp_path / "other")
    third = trained.load_checkpoint(
        checkpoints.finished(tmp_path / "other", "cross_view_small")
    ).module
    weights = [torch.cat([p.flatten() for p in m.parameters()]) for m in (first, second, third)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.allclose(weights[0], weights[2])


def test_an_interrupted_run_resumes_as_if_uninterrupted(run, settings, data, tmp_path, monkeypatch):
    step, seen = ReconstructionModule.training_step, []

    def breaking(self, batch, batch_idx):
        if self.global_step == 2 and len(seen) == 2:
            seen.append("broken")
            raise RuntimeError("power cut")
        seen.append(self.global_step)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(ReconstructionModule, "training_step", breaking)
    with pytest.raises(RuntimeError, match="power cut"):
        fit.fit("cross_view_small", settings, data, tmp_path)
    assert checkpoints.unfinished(tmp_path, "cross_view_small").exists()
    before = torch.load(checkpoints.unfinished(tmp_path, "cross_view_small"))
    fit.fit("cross_view_small", settings, data, tmp_path)
    after = trained.load_checkpoint(checkpoints.finished(tmp_path, "cross_view_small"))
    assert seen == [0, 1, "broken", 2]
    assert before["global_step"] == 2 and after.steps == 3
    assert after.seconds > before["callbacks"]["Clock"]["seconds"] > 0
    unbroken = trained.load_checkpoint(
        checkpoints.finished(run, "cross_view_small")
    ).module.state_dict()
    assert all(
        torch.equal(value, unbroken[name]) for name, value in after.module.state_dict().items()
    )
    fit.fit("cross_view_small", settings, data, tmp_path)
    assert seen[-1] == 2, "a finished method is not trained again"


def test_a_loss_that_is_not_finite_stops_with_a_remedy(settings, data, tmp_path):
    wild = copy.deepcopy(settings)
    wild.optimizer |= {"lr": 1e30, "schedule": "constant", "warmup": 0.0}
    with pytest.raises(
        FloatingPointError, match=r"cross_view is not finite at step [12]: .*optimizer.lr"
    ):
        fit.fit("cross_view_small", wild, data, tmp_path)
    assert not checkpoints.finished(tmp_path, "cross_view_small").exists()


def test_a_checkpoint_contains_the_averaged_weights(run, settings, data, tmp_path):
    averaging = {
        "_target_": "lightning.pytorch.callbacks.EMAWeightAveraging",
        "decay": 0.5,
        "use_buffers": False,
    }
    fit.fit("cross_view_small", replace(settings, callbacks={"ema": averaging}), data, tmp_path)
    path = checkpoints.finished(tmp_path, "cross_view_small")
    state, loaded = torch.load(path), trained.load_checkpoint(path).module.state_dict()
    plain = trained.load_checkpoint(
        checkpoints.finished(run, "cross_view_small")
    ).module.state_dict()
    assert all_plain(state["averaging_state"])
    assert all(torch.equal(loaded[name], state["state_dict"][name]) for name in loaded)
    assert any(not torch.equal(loaded[name], plain[name]) for name in loaded)


def test_methods_without_weights_are_not_trained(settings, data, tmp_path):
    for method in ("sirt", "backprojection"):
        fit.fit(method, replace(settings, compare={method: {"name": method}}), data, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_label_cannot_be_used_twice(settings):
    twice = replace(settings, compare={"cross_view_small": {"name": "sirt"}})
    with pytest.raises(ValueError, match="'cross_view_small'.*own label"):
        twice.methods()
    assert list(replace(settings, compare={"sirt": None}).methods()) == ["cross_view_small"]


def test_the_main_method_is_named_by_its_config_file(settings):
    """A class has several files."""
    counts = TrainSettings(**compose("experiment=smoke", "method=cross_view_counts"))
    assert counts.method["name"] == settings.method["name"] == "cross_view"
    assert list(counts.methods()) == ["cross_view_counts", "sirt"]
    mine = TrainSettings(**compose("experiment=smoke", "method=world_unet", "label=mine"))
    assert list(mine.methods()) == ["mine", "sirt"]
    assert list(replace(counts, label=None).methods()) == ["cross_view", "sirt"]


def test_no_method_can_be_labelled_as_the_truth(settings):
    """A method labelled "truth", whose volume would overwrite the true one, is refused."""
    for label in ("truth", "Truth"):
        with pytest.raises(ValueError, match=f"labelled '{label}' would overwrite truth.nii.gz"):
            replace(settings, compare={label: {"name": "sirt"}}).methods()


@pytest.mark.parametrize(
    "label", ["SIRT", "Sirt", "sirt.ckpt", "Sirt.previous", "sirt.previous.ckpt"]
)
def test_no_two_methods_write_files_of_one_name(label, settings):
    """Volumes and checkpoints, on file systems that ignore case as well."""
    for main, other in ((label, "sirt"), ("sirt", label)):
        chosen = replace(settings, label=main, compare={other: {"name": "sirt"}})
        with pytest.raises(ValueError, match=f"labelled '{main}' and '{other}' would write files"):
            chosen.methods()
    for free in ("sirt2", "views", "planes", "truth2", "sirt.nii.gz", "results", "last"):
        assert free in replace(settings, compare={free: {"name": "sirt"}}).methods()


def test_an_unfinished_method_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"mine.ckpt: did the training of 'mine' end\?"):
        trained.load_checkpoint(checkpoints.finished(tmp_path, "mine"))


def test_a_run_folder_is_found_from_any_file_in_it(tmp_path):
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "config.yaml").write_text("name: run\n")
    file = tmp_path / "run" / "checkpoints" / "a.ckpt"
    file.touch()
    assert {folder_of_run(p) for p in (file, file.parent, tmp_path / "run")} == {tmp_path / "run"}
    with pytest.raises(FileNotFoundError, match="No checkpoint or run folder is at .*nowhere"):
        folder_of_run(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="with config.yaml"):
        folder_of_run(tmp_path)


def test_the_progress_line_has_the_label_of_the_table(settings, tmp_path):
    compared = {**settings.compare, "other": settings.method}
    both = replace(settings, compare=compared, callbacks=compose()["callbacks"])
    for label in (settings.method["name"], "other"):
        line = fit.build_trainer(both, tmp_path, label).progress_bar_callback
        assert isinstance(line, StepProgress) and line.label == label


@pytest.mark.parametrize("precision", ["bf16-mixed", "bf16", "16-mixed", "bf16-true", "16-true"])
def test_half_precision_on_a_cpu_is_refused(precision, settings, tmp_path):
    """oneDNN's gradients of a convolution of 3x3 pixels with strides of 2, of any size, of 3x3x3
    voxels in two slices, and of 4x4x4 with strides were found to be arbitrary in bfloat16.
    """
    label, trainer = settings.method["name"], {**settings.trainer, "accelerator": "cpu"}
    with pytest.raises(ValueError, match="on a CPU, .*arbitrary; expected one of .*32-true"):
        options = trainer | {"precision": precision}
        fit.build_trainer(replace(settings, trainer=options), tmp_path, label)
    for full in ("32-true", 32, "64-true"):
        fit.build_trainer(replace(settings, trainer=trainer | {"precision": full}), tmp_path, label)


def test_a_run_shorter_than_the_interval_of_validations_has_one(settings, tmp_path):
    label, trainer = settings.method["name"], {**settings.trainer, "val_check_interval": 100}
    for steps, batches, interval in ((60, 1, 60), (60, 3, 100), (200, 1, 100)):
        length = {"max_steps": steps, "accumulate_grad_batches": batches}
        built = fit.build_trainer(replace(settings, trainer=trainer | length), tmp_path, label)
        assert built.val_check_interval == interval


@pytest.mark.parametrize(
    "options",
    [
        {"val_check_interval": 0.5, "check_val_every_n_epoch": None},
        {"limit_train_batches": 1.5},
        {"gradient_clip_algorithm": "sped"},
        {"max_time": "sped"},
        {"profiler": "sped"},
        {"enable_checkpointing": False},
    ],
)
def test_what_lightning_refuses_is_an_error_of_the_settings(options, settings, tmp_path):
    """Not a traceback; also tried: other limits, fast_dev_run=-1, and of callbacks, a Timer without
    a time and a ModelCheckpoint of a value that is not logged.
    """
    label, trainer = settings.method["name"], {**settings.trainer, **options}
    callbacks = {"best": {"_target_": "lightning.pytorch.callbacks.ModelCheckpoint"}}
    given = replace(settings, trainer=trainer, callbacks=callbacks)
    with pytest.raises(ValueError, match=r"trainer, callbacks or logger: .*"):
        fit.build_trainer(given, tmp_path, label)
