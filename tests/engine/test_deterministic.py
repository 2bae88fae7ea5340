"""`trainer.deterministic=true`: it trains, to the same bits, and which layers a GPU would refuse under it."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from mvrecon.config import compose
from mvrecon.engine import checkpoints, fit

#: What torch.use_deterministic_algorithms refuses on CUDA (its documentation, torch 2.13), of what a network may hold.
REFUSED = {
    "avg_pool3d_backward",
    "_adaptive_avg_pool2d_backward",
    "_adaptive_avg_pool3d_backward",
    "adaptive_max_pool2d_backward",
    "bincount",
    "cumsum",
    "grid_sampler_2d_backward",
    "grid_sampler_3d_backward",
    "histc",
    "put_",
    "reflection_pad3d_backward",
    "upsample_bicubic2d_backward",
    "upsample_linear1d_backward",
}


class Recorded(TorchDispatchMode):
    """The names of the operations that run."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


@pytest.fixture
def strict():
    yield
    torch.use_deterministic_algorithms(False)


SMALL = (
    "grid.shape=[16,16,16]",
    "grid.spacing=8.0",
    "camera.views=4",
    "camera.detector.pixels=[24,24]",
    "camera.detector.pixel_mm=11.0",
    "data.sizes={train: 2, val: 1, test: 1}",
)


@pytest.mark.xfail(
    strict=True, raises=AssertionError, reason="F.avg_pool3d in mvrecon/models: its backward is refused on CUDA"
)
@pytest.mark.parametrize("model", ["cross_view", "backprojection_unet", "geometry_free", "mean_fusion"])
def test_no_layer_is_refused_on_a_gpu(model):
    settings = compose(f"model={model}", *SMALL)
    data = fit.build_data(settings)
    data.setup("fit")
    module = fit.build_module(settings, settings["model"], data.data_range)
    batch = next(iter(data.train_dataloader()))
    with Recorded() as seen:
        module.loss(module.model(batch["views"]), batch)["total"].backward()
    assert "convolution_backward" in seen.names
    assert seen.names & REFUSED == set()


def test_deterministic_training_has_the_bits_of_any_other_on_the_cpu(tmp_path, strict):
    settings = compose("experiment=smoke")
    data = fit.build_data(settings)
    weights = []
    for deterministic in (False, True, True):
        run = tmp_path / str(len(weights))
        fit.fit(
            "cross_view", {**settings, "trainer": settings["trainer"] | {"deterministic": deterministic}}, data, run
        )
        weights.append(checkpoints.load(checkpoints.finished(run, "cross_view")).module.state_dict())
    assert torch.are_deterministic_algorithms_enabled()
    assert all(torch.equal(weights[0][name], other[name]) for other in weights[1:] for name in weights[0])
