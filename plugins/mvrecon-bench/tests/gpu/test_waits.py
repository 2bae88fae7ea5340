"""What a training step waits for on a GPU: nothing, counted by a stand-in for one."""

from types import SimpleNamespace

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.parts import METHODS
from mvrecon.geometry.lattice import lifted_maps
from mvrecon.kernels.warps import warp
from mvrecon.operators.visual_hull.support import hull_mask
from mvrecon.training.callbacks import Clock
from mvrecon.training.fit import build_data
from mvrecon.training.module import NanGuard, ReconstructionModule
from mvrecon.training.settings import TrainSettings
from mvrecon_bench.gpu.as_gpu import GPU, AsGpu, OnGpu, on_gpu

DETECTOR = {"pixels": [12, 12], "pixel_mm": 5.0}
CONE = {"name": "circular", "n_views": 3, "sid": 100.0, "sdd": 200.0, "detector": DETECTOR}
#: Methods with weights or frusta of cameras, which a training step is tested of.
TRAINED = {
    "cross_view": {},
    "world_unet": {},
    "mean_fusion": {},
    "geometry_free": {"n_cameras": 3},
    "uncertain": {"method": {"name": "world_unet"}},
}
#: What methods wait for before their first iteration: numbers that all iterations use; of
#: counts the checks, and the lists of rays that have some, one of each for each of two subsets, and
#: twice in other units.
BEFORE = {
    **{"sirt": 0, "os_sart": 0, "cgls": 0, "tikhonov": 1, "pdhg_tv": 1, "fista_tv": 2},
    **{"mlem": 3, "osem": 5, "bsrem": 7, "tv_map": 7},
}
LOSS = {"per_view_gain": 1e-3, "cross_view": 0.1}
#: Kept as long as the tests: modules refer to it weakly.
TRAINER = SimpleNamespace(log_every_n_steps=10, global_step=1, current_epoch=0)


def module_of(name: str, **options) -> tuple[ReconstructionModule, dict]:
    """A method in training, and a batch for it."""
    geometry = {
        "grid": {"size": [12, 12, 12], "spacing": 2.0},
        "camera": CONE,
        "projector": {"name": "drr"},
    }
    torch.manual_seed(0)
    method = {"name": name, **TRAINED.get(name, {}), **options}
    module = ReconstructionModule(geometry, method, LOSS, {"name": "adamw"}, 1.0)
    module.trainer, module.log = TRAINER, lambda *_, **__: None
    x = torch.zeros(1, 1, 12, 12, 12)
    x[..., 4:8, 3:8, 5:9] = 1
    with torch.no_grad():
        batch = {"views": module.projector(x), "volume": x, "inside": x > 0.5}
    return module.train(), batch


def stepped(module: ReconstructionModule, batch: dict) -> AsGpu:
    """A step of training on the stand-in, as Lightning does it, behind a forward pass, in which the
    geometry of the operator is computed.
    """
    with AsGpu() as gpu:
        gpu.put(module)
        batch = {name: on_gpu(value) for name, value in batch.items()}
        weights = [p for p in module.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(weights)
        with torch.no_grad():
            module.training_step(batch, 0)
        gpu.waits.clear()
        module.training_step(batch, 0).backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        optimizer.zero_grad()
    return gpu


@pytest.mark.parametrize("name", TRAINED)
def test_a_training_step_waits_for_nothing(name):
    gpu = stepped(*module_of(name))
    assert not gpu.waits, dict(gpu.waits)


@pytest.mark.parametrize(("name", "waits"), [("sirt", 0), ("backprojection", 0), ("aligned", 1)])
def test_a_classical_method_on_a_gpu_waits_for_its_rig_alone(name, waits):
    """The volume is that of main memory; alignment reads the cameras' geometry once."""
    options = {"method": {"name": "sirt"}} if name == "aligned" else {}
    module, batch = module_of(name, **options)
    module.eval()
    expected = module(batch["views"])
    with torch.no_grad(), AsGpu() as gpu:
        gpu.put(module)
        result = module(on_gpu(batch["views"]))
        assert gpu.waits.total() == waits, dict(gpu.waits)
    torch.testing.assert_close(result.volume.values, expected.volume, rtol=1e-4, atol=1e-5)


@pytest.fixture(scope="module")
def scanned():
    module, batch = module_of("sirt")
    return module, batch["views"]


def reconstructed(scanned, name: str, iterations: int, break_off: bool = False):
    """A method's volume on the stand-in, and what it waited for."""
    (module, views), method = scanned, METHODS.get(name)
    views = views.masked_fill(views == views.max(), torch.nan) if break_off else views
    with AsGpu() as gpu:
        gpu.put(module)
        return method(module.projector, on_gpu(views), iterations=iterations).values, gpu.waits


@pytest.mark.parametrize("name", BEFORE)
def test_no_iteration_waits(name, scanned):
    for iterations in (1, 3):
        _, waits = reconstructed(scanned, name, iterations)
        assert waits.total() == BEFORE[name], dict(waits)


def test_conjugate_gradients_that_nobody_stops_stay_where_they_are_done(scanned):
    volume, waits = reconstructed(scanned, "cgls", 60)
    expected = METHODS.get("cgls")(module_of("sirt")[0].projector, scanned[1], iterations=60)
    torch.testing.assert_close(volume, expected, rtol=1e-4, atol=1e-5)
    assert not waits


@pytest.mark.parametrize("name", [name for name, waits in BEFORE.items() if waits < 3])
def test_a_view_that_is_not_finite_shows_in_the_volume_of_a_gpu(name, scanned):
    """Iterative methods of a GPU, which do not wait to look at their views, give NaN where a view
    is not finite, never a volume of numbers alone.
    """
    volume, _ = reconstructed(scanned, name, 2, break_off=True)
    assert not volume.isfinite().all()


def test_a_step_with_uncertainty_waits_for_nothing_and_learns():
    module, batch = module_of("uncertain", method={"name": "cross_view"})
    before = [p.clone() for p in module.parameters()]
    gpu = stepped(module, batch)
    assert not gpu.waits and gpu.launches["project"] > 10 and gpu.launches["backproject"] > 10
    after = [p.values for p in module.parameters()]
    assert sum(not torch.equal(a, b) for a, b in zip(before, after, strict=True)) > 10


CROPS = {
    "a hull": ({"support": "hull"}, 0),
    "its boxes": ({"support": "auto", "crop": True}, 1),
}


@pytest.mark.parametrize("what", CROPS)
def test_a_hull_is_waited_for_where_sizes_depend_on_it_alone(what):
    """The boxes of the volume network are read at once."""
    options, waits = CROPS[what]
    gpu = stepped(*module_of("cross_view", **options))
    assert gpu.waits.total() == waits, dict(gpu.waits)
    assert {why for _, why in gpu.waits} <= {"tolist", "copied to main memory"}


def test_a_hull_on_a_gpu_keeps_what_views_that_are_not_finite_show():
    module, batch = module_of("cross_view")
    views, grid = batch["views"], module.projector.grid
    views[0, 0, :, 0, 0] = float("nan")  # background without it
    views[0, 0, :, -1, -1] = float("-inf")
    with AsGpu() as gpu:
        mask = hull_mask(on_gpu(views), module.projector.cameras, grid).values
        gpu.waits.clear()
        again = hull_mask(on_gpu(views), module.projector.cameras, grid).values
    views[0, 0, :, [0, -1], [0, -1]] = 1.0
    expected = hull_mask(views, module.projector.cameras, grid)
    assert torch.equal(mask, expected) and torch.equal(again, expected) and not gpu.waits


def test_a_half_volume_on_a_gpu_is_read_as_it_is():
    """No copy in float32 comes before the kernel of a warp; one in the volume's type behind it."""
    size, other = (5, 6, 7), (4, 5, 6)
    torch.manual_seed(0)
    maps = lifted_maps(torch.eye(4, dtype=torch.float64) + 0.03 * torch.rand(2, 2, 4, 4).double())
    x = torch.randn(2, 2, 3, *size, dtype=torch.bfloat16)
    with AsGpu() as gpu:
        leaf = on_gpu(x).requires_grad_()
        values = warp(leaf, on_gpu(maps), other)
        assert gpu.launches == {"warp": 1, "_to_copy": 1} and not gpu.waits
        values.float().square().sum().backward()
    assert values.dtype == leaf.grad.dtype == torch.bfloat16
    assert torch.equal(values.values, warp(x, maps, other))


def test_the_stand_in_has_no_integer_product_as_a_gpu_has_none():
    with AsGpu(), pytest.raises(RuntimeError, match="a GPU has none of torch.int64"):
        OnGpu(torch.ones(2, 2).long()) @ OnGpu(torch.ones(2).long())


def test_the_stand_in_has_the_numbers_and_derivatives_of_main_memory():
    torch.manual_seed(0)
    weights, x = torch.randn(4, 3, requires_grad=True), torch.randn(5, 4)
    loss = (x @ weights).relu().square().sum()
    loss.backward()
    with AsGpu() as gpu:
        moved = torch.nn.Parameter(OnGpu(weights.detach().clone()))
        again = (on_gpu(x) @ moved).relu().square().sum()
        again.backward()
        assert moved.grad is not None and moved.grad.device.type == "cuda"
        assert torch.equal(moved.grad.values, weights.grad) and not gpu.waits
        assert again.item() == loss.item() and gpu.waits.total() == 1


WAITING = {
    "item": lambda x: x.sum().item(),
    "bool": lambda x: bool((x > 0).any()),
    "tolist": lambda x: x.tolist(),
    "cpu": lambda x: x.cpu(),
    "an inverse": lambda x: torch.linalg.inv(x.diag()),
    "a pseudo-inverse": lambda x: torch.linalg.pinv(x.diag(), hermitian=True),
    "nonzero": lambda x: x.nonzero(),
    "a mask": lambda x: x[x > 0],
    "a list of indices": lambda x: x[[0, 1]],
    "indices of main memory": lambda x: x[torch.tensor([0, 1])],
    "a tensor of numbers": lambda x: torch.tensor([1.0], device=x.device),
    "new_tensor": lambda x: x.new_tensor([1.0]),
    "to the device": lambda x: torch.zeros(3).to(x.device),
    "copy_": lambda x: x.copy_(torch.zeros(3)),
}


@pytest.mark.parametrize("what", WAITING)
def test_the_stand_in_sees_what_waits(what):
    with AsGpu() as gpu:
        WAITING[what](OnGpu(torch.ones(3)))
    assert gpu.waits.total() == 1


def test_the_stand_in_refuses_tensors_of_two_memories():
    with AsGpu(), pytest.raises(RuntimeError, match="on cuda:0 and in main memory"):
        OnGpu(torch.ones(3)) + torch.ones(3)
    with AsGpu() as gpu:  # a number is no tensor of either
        assert (OnGpu(torch.ones(3)) + torch.tensor(1.0)).values.sum() == 6
        assert not gpu.waits


@pytest.mark.parametrize("name", TRAINED)
def test_views_that_are_not_finite_make_no_number_on_a_gpu(name):
    """Views on a GPU that are not finite, for which nobody waits, give a volume of NaN, never a
    number.
    """
    module, batch = module_of(name)
    batch["views"][0, 0, 1, 4, 5] = float("inf")
    with torch.no_grad(), AsGpu() as gpu:
        gpu.put(module)
        volume = module(on_gpu(batch["views"])).volume
    assert volume.values.isnan().all()


def test_a_bad_loss_on_a_gpu_is_refused_with_its_step():
    """A loss on a GPU that is not finite ends the training by the next logged step, and before a
    checkpoint is written.
    """
    good, bad = ({"edges": torch.tensor(1.0), "total": torch.tensor(v)} for v in (2.0, torch.nan))
    with AsGpu() as gpu:
        losses = NanGuard("a_model")
        for step, terms in enumerate([good, bad, good]):
            losses.add(step, {name: on_gpu(x) for name, x in terms.items()}, 4)
        assert not gpu.waits
        with pytest.raises(FloatingPointError, match="a_model is not finite at step 1: edges 1, "):
            losses.check()
        losses.check()  # the others have been checked
        for step in range(4):
            losses.add(step, {name: on_gpu(x) for name, x in good.items()}, 4)
        assert gpu.waits.total() == 2
    with pytest.raises(FloatingPointError, match="at step 7"):
        NanGuard("a_model").add(7, bad, 100)  # in main memory at once


def test_what_is_logged_beside_the_loss_stays_in_main_memory():
    """Lightning would copy plain numbers to the device, and wait."""
    logged = {}
    module = SimpleNamespace(log_dict=lambda values, batch_size: logged.update(values))
    Clock().on_train_batch_end(
        SimpleNamespace(world_size=1), module, None, {"views": torch.zeros(2)}, 0
    )
    assert logged and all(value.is_cpu for value in logged.values())


def test_the_number_of_a_batch_s_rig_stays_on_the_host(monkeypatch):
    import lightning.pytorch as L

    monkeypatch.setattr(
        L.LightningDataModule,
        "transfer_batch_to_device",
        lambda self, batch, device, index: {name: on_gpu(x) for name, x in batch.items()},
    )
    data, (_, batch) = (
        build_data(TrainSettings(**compose("experiment=smoke"))),
        module_of("geometry_free"),
    )
    moved = data.transfer_batch_to_device({**batch, "rig": torch.tensor([0])}, GPU, 0)
    assert isinstance(moved["views"], OnGpu) and moved["rig"].is_cpu
