"""One set of weights on many rigs: trained, written into one file, and used on a rig never seen."""

import warnings

import pytest
import torch

import mvrecon as mv
import mvrecon.apps.eval
from mvrecon.apps.config import absolute_paths, compose
from mvrecon.apps.settings import EvalSettings
from mvrecon.core.files import runs as places
from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import PROJECTORS
from mvrecon.methods.method import build_method
from mvrecon.operators.operator import Projector
from mvrecon.training import fit, run_folder
from mvrecon.training.settings import TrainSettings
from mvrecon.training.trained_method import TrainedMethod
from tests.geometry.cameras.rigs import OPTIONS
from tests.methods.learned.rig import small_projector
from tests.training.runs import call

SMALL = {
    "widths": [4, 8],
    "depth_widths": [4],
    "weight_widths": [4],
    "scale": 1,
    "depths": 4,
    "start": 2,
}
SETTINGS = (
    "camera=random",
    "callbacks=quiet",
    "logger=csv",
    "optimizer.lr=1e-3",
    "trainer={max_steps: 3, val_check_interval: 3, accelerator: cpu}",
    "camera.n_views=[3,4]",
    "camera.pixels=[13,17]",
    "method=cross_view",
    *(f"method.{name}={value}" for name, value in SMALL.items()),
    "grid.size=[8,8,8]",
    "grid.spacing=16.0",
    "data={rigs: 3, sizes: {train: 6, val: 1, test: 1}}",
    "projector.backend=reference",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Three steps, on a batch of each of three rigs."""
    folder = tmp_path_factory.mktemp("run")
    settings = TrainSettings(**compose(*SETTINGS))
    run_folder.start(folder, vars(settings))
    fit.fit("cross_view", settings, fit.build_data(settings), folder)
    return folder


def a_rig(n_views):
    options = {**OPTIONS["random"], "n_views": (n_views, n_views), "seed": 77}
    grid = mv.Grid.centred(9, spacing=12.0)
    return PROJECTORS.build("drr", grid=grid, cameras=mv.random_rig(**options))


def test_a_step_on_one_rig_is_a_step_of_the_weights_on_all():
    """Weights trained on one rig reconstruct from another as if they had never been called on the
    first.
    """
    options = {"name": "cross_view", **SMALL}
    A, B = small_projector(4), small_projector(3, pixels=10)
    method, copy = build_method(options), build_method(options)
    optimizer = torch.optim.SGD(method.parameters(), lr=0.1)
    truth = torch.rand(1, 1, *B.grid.shape)
    before = method(B(truth), B).volume
    method(A(truth), A).volume.square().mean().backward()
    optimizer.step()
    copy.load_state_dict(method.state_dict())
    after = method(B(truth), B).volume
    assert torch.equal(copy(B(truth), B).volume, after)
    assert not torch.equal(after, before)


def module_and_data(*options):
    settings = TrainSettings(**compose(*SETTINGS, *options))
    data = fit.build_data(settings)
    data.setup("fit")
    return fit.build_module(settings, settings.method, data.data_range), data


def test_the_operator_of_a_batch_matches_its_rig(monkeypatch):
    """It is built once for each rig, and sees about the same as the scenes' exact views."""
    module, data = module_and_data()
    built, build = [], module._projector
    monkeypatch.setattr(module, "_projector", lambda rig: built.append(rig) or build(rig))
    operators = {}
    for batch in data.train_dataloader():
        A = module.operator(batch)
        assert (A(batch["volume"]) - batch["views"]).norm() < 0.35 * batch["views"].norm()
        operators.setdefault(int(batch["rig"][0]), set()).add(A)
    assert len(operators) == 3 and all(len(same) == 1 for same in operators.values())
    assert sorted(built) == sorted(rig for rig in operators if rig)
    assert not any("projector" in name for name in module.state_dict())


class OfCase(Projector):
    """Twice an operator for every case that is not named "plain"."""

    def __init__(self, A):
        super().__init__()
        self.A, self.grid, self.cameras = A, A.grid, A.cameras

    def for_case(self, case):
        return self.A if case["name"][0] == "plain" else 2.0 * self.A


@torch.no_grad()
def test_a_case_with_its_own_operator_is_reconstructed_with_it():
    """By `for_case`, for a step and a validation alike: the same volume from twice the views."""
    module, _ = module_and_data("data.rigs=0")
    module.projector = OfCase(module.eval().projector)
    truth = torch.rand(1, 1, *module.projector.grid.shape)
    inside, losses = torch.ones_like(truth, dtype=torch.bool), []
    for name in ("plain", "doubled"):
        A = module.operator({"name": [name]})
        batch = {"volume": truth, "views": A(truth), "inside": inside, "name": [name]}
        losses.append(module.terms(batch)["volume"].item())
        out = module.validation_step(batch, 0)["out"]
        torch.testing.assert_close(out.volume, module(batch["views"], A).volume)
    assert losses[0] == pytest.approx(losses[1], rel=0.2)


def test_per_camera_networks_refuse_another_number_of_cameras():
    options = {"name": "cross_view", **SMALL, "shared": False, "n_cameras": 4}
    method, A = build_method(options), small_projector(3)
    with pytest.raises(ValueError, match="Expected 4 cameras, got 3"):
        method(A(torch.rand(4, 1, *A.grid.shape)), A)


def test_saved_weights_are_the_trained_ones_and_support_an_unseen_rig(run, tmp_path, monkeypatch):
    path = mv.save_weights(run, tmp_path / "ours.safetensors")
    ours, first = mv.load(path), mv.load(run)
    assert ours.steps == first.steps == 3
    weights = first.module.state_dict()
    assert any(value.any() for name, value in weights.items() if name.endswith("entry.weight"))
    assert all(torch.equal(value, weights[k]) for k, value in ours.module.state_dict().items())
    monkeypatch.setattr(places, "WEIGHTS_FOLDER", tmp_path)
    A = a_rig(5)
    views = A(torch.full((1, 1, *A.grid.shape), 0.5))
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        volume = TrainedMethod("ours")(views, A).volume
    assert volume.shape[2:] == A.grid.shape and volume.isfinite().all() and volume.any()
    words = [str(w.message) for w in messages if "trained with" in str(w.message)]
    assert len(words) == 1 and "another grid" in words[0], "any rig is as in training"
    settings = absolute_paths({"checkpoint": "ours"}, EvalSettings)
    assert settings == {"checkpoint": str(path)}
    with pytest.raises(FileNotFoundError, match="is at .*theirs.*Known: ours"):
        mv.load("theirs")


def test_a_flipped_bit_or_a_foreign_file_of_weights_is_refused(run, tmp_path):
    """Weights with a flipped bit, without a description or cut short are refused."""
    path = mv.save_weights(run, tmp_path / "ours.safetensors")
    raw = path.read_bytes()
    for bad, message in (
        (raw[:-1] + bytes([raw[-1] ^ 1]), "is damaged, .* expected the SHA-256"),
        (raw[:-8], "is no .safetensors file"),
        (raw.replace(b'"mvrecon"', b'"foreign"', 1), "expected a description"),
    ):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match=message):
            mv.load(path)
    with pytest.raises(ValueError, match=r"Expected a file \.safetensors"):
        mv.save_weights(run, tmp_path / "ours.bin")


def test_no_bit_of_a_file_of_weights_is_outside_its_checksum(run, tmp_path):
    """A bit that flips anywhere in a file of weights, its description among it, is noticed."""
    path = mv.save_weights(run, tmp_path / "ours.safetensors")
    raw = path.read_bytes()
    header = 8 + int.from_bytes(raw[:8], "little")
    for place in (*range(8), *range(8, header, 31), *range(header, len(raw), 1009)):
        bad = bytearray(raw)
        bad[place] ^= 1 << place % 8
        path.write_bytes(bad)
        with pytest.raises(Refused):
            mv.load(path)
    path.write_bytes(raw)
    assert mv.load(path).steps == 3


def test_a_run_is_evaluated_on_another_rig_and_grid(run, tmp_path):
    options = ("+camera.n_views=[5,5]", "+grid.size=[9,9,7]", "device=cpu")
    where = f"hydra.run.dir={tmp_path}"
    assert call(mvrecon.apps.eval, f"checkpoint={run}", *options, where) == 0
    merged = mvrecon.apps.eval.merged(
        run_folder.read_settings(run),
        EvalSettings(**compose(f"checkpoint={run}", *options, config_name="eval")),
    )
    assert merged.camera["n_views"] == [5, 5] and merged.camera["pixels"] == [13, 17]
    assert merged.grid == {"size": [9, 9, 7], "spacing": 16.0}
    wrong = (f"checkpoint={run}", "+camera.n_view=[5,5]", where + "_2")
    assert call(mvrecon.apps.eval, *wrong) != 0
