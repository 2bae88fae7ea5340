"""A training step does not synchronise with the GPU, as counted by an emulated GPU."""

from types import SimpleNamespace

import pytest
import torch

from mvrecon.training.module import ReconstructionModule
from mvrecon_bench.gpu.as_gpu import AsGpu, on_gpu

DETECTOR = {"pixels": [12, 12], "pixel_mm": 5.0}
CONE = {"name": "circular", "n_views": 3, "sid": 100.0, "sdd": 200.0, "detector": DETECTOR}
PARALLEL = {"name": "parallel", "n_views": 4, "detector": {"pixels": [12, 20], "pixel_mm": 2.0}}
FILTERING = ("fbp_unet", "sinogram_unet", "dual_domain", "itnet")
OTHERS = ("dif_net", "svct", "primal_dual", "radon_unet")
#: Modules refer to it weakly.
TRAINER = SimpleNamespace(log_every_n_steps=10, global_step=1, current_epoch=0)


def module_of(name: str) -> tuple[ReconstructionModule, dict[str, torch.Tensor]]:
    """A method in training, and a batch for it."""
    flat = name in FILTERING
    geometry = {
        "grid": {"size": [12, 12, 12], "spacing": 2.0},
        "camera": PARALLEL if flat else CONE,
        "projector": {"name": "radon" if flat else "drr"},
    }
    method = {"name": name} | ({"n_cameras": 3} if name == "radon_unet" else {})
    torch.manual_seed(0)
    loss = {"edges": 0.1, "completed_views": 1.0}
    module = ReconstructionModule(geometry, method, loss, {"name": "adamw"}, 1.0)
    module.trainer, module.log = TRAINER, lambda *_, **__: None
    x = torch.zeros(1, 1, 12, 12, 12)
    x[..., 4:8, 3:8, 5:9] = 1
    with torch.no_grad():
        batch = {"views": module.projector(x), "volume": x, "inside": x > 0.5}
    return module.train(), batch


@pytest.mark.parametrize("name", [*FILTERING, *OTHERS])
def test_a_training_step_does_not_synchronise(name):
    """After the first step, which moves cached tensors to the device."""
    module, batch = module_of(name)
    with AsGpu() as gpu:
        gpu.put(module)
        batch = {name: on_gpu(value) for name, value in batch.items()}
        optimizer = torch.optim.AdamW(module.parameters())
        with torch.no_grad():
            module.training_step(batch, 0)
        gpu.waits.clear()
        module.training_step(batch, 0).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimizer.step()
        assert not gpu.waits


@pytest.mark.parametrize("name", ["dif_net", "fbp_unet", "primal_dual"])
def test_non_finite_views_give_a_nan_volume_on_a_gpu(name):
    """Non-finite views, which are not checked on a GPU, result in a NaN volume."""
    module, batch = module_of(name)
    batch["views"][0, 0, 1, 4, 5] = float("inf")
    with torch.no_grad(), AsGpu() as gpu:
        gpu.put(module)
        volume = module(on_gpu(batch["views"])).volume
    assert volume.values.isnan().all()
