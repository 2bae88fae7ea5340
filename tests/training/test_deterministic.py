"""`trainer.deterministic=true`: it trains, to the same bits, and no layer of it is one that a GPU
refuses.
"""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from mvrecon.apps.config import compose
from mvrecon.kernels import operator
from mvrecon.kernels.threads import in_one_order, parallel_for
from mvrecon.training import checkpoints, fit, trained
from mvrecon.training.settings import TrainSettings

#: What torch.use_deterministic_algorithms refuses on CUDA (its documentation, torch 2.13), of what
#: a network may hold.
REFUSED = {
    "avg_pool3d_backward",
    "_adaptive_avg_pool2d_backward",
    "_adaptive_avg_pool3d_backward",
    "adaptive_max_pool2d_backward",
    "bincount",
    "cumsum",
    "fractional_max_pool2d_backward",
    "fractional_max_pool3d_backward",
    "grid_sampler_2d_backward",
    "grid_sampler_3d_backward",
    "histc",
    "max_unpool2d",
    "max_unpool3d",
    "median",
    "nll_loss_forward",
    "put_",
    "reflection_pad1d_backward",
    "reflection_pad2d_backward",
    "reflection_pad3d_backward",
    "upsample_bicubic2d_backward",
    "upsample_bilinear2d_backward",
    "upsample_linear1d_backward",
    "upsample_trilinear3d_backward",
}


class Recorded(TorchDispatchMode):
    """The names of the operations that run; cumsum only of numbers with a point, since a GPU counts
    in any order.
    """

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out, name = func(*args, **(kwargs or {})), func.overloadpacket.__name__
        if name != "cumsum" or out.is_floating_point():
            self.names.add(name)
        return out


@pytest.fixture
def strict():
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.fixture
def taken_for_a_gpu(strict, monkeypatch):
    """A CPU that torch and mvrecon treat as a GPU without compiled kernels."""
    monkeypatch.setattr(torch.Tensor, "is_cpu", property(lambda _: False))
    monkeypatch.setattr(torch.Tensor, "is_cuda", property(lambda _: True))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)  # also where there is one
    monkeypatch.setattr(operator, "COMPILED", False)


SMALL = (
    "grid.size=[11,10,12]",
    "grid.spacing=10.0",
    "camera.n_views=4",
    "camera.detector.pixels=[12,12]",
    "camera.detector.pixel_mm=22.0",
    "data.sizes={train: 2, val: 1, test: 1}",
)
METHODS = {
    "cross_view_small": (),
    "cross_view_small, cropped to its hull": ("method.support=hull", "method.crop=true"),
    "world_unet": ("method.widths=[4,8]",),
    "geometry_free": ("method.widths=[4,8]",),
    "mean_fusion": ("method.widths=[4]", "method.depths=8"),
}


@pytest.mark.parametrize("method", METHODS)
def test_all_layers_are_deterministic_on_a_gpu(method, taken_for_a_gpu):
    settings = TrainSettings(
        **compose(f"method={method.partition(',')[0]}", *SMALL, *METHODS[method])
    )
    data = fit.build_data(settings)
    data.setup("fit")
    module = fit.build_module(settings, settings.method, data.data_range)
    batch = next(iter(data.train_dataloader()))
    with Recorded() as seen:
        module.terms(batch)["total"].backward()
    assert "convolution_backward" in seen.names
    assert seen.names & REFUSED == set()


def test_non_deterministic_gpu_operations_would_be_detected(taken_for_a_gpu):
    x = torch.rand(1, 1, 4, 4, 4, requires_grad=True)
    with Recorded() as seen:
        (
            F.avg_pool3d(x, 2).sum()
            + F.grid_sample(x, torch.zeros(1, 1, 1, 1, 3), align_corners=False).sum()
        ).backward()
        torch.ones(2).cumsum(0), torch.ones(2, dtype=torch.bool).cumsum(0)
        F.interpolate(
            x, scale_factor=2, mode="trilinear"
        ).sum().backward()  # torch has another way for it
    assert seen.names & REFUSED == {"avg_pool3d_backward", "grid_sampler_3d_backward", "cumsum"}


def test_explicit_rays_on_a_gpu_are_reported_as_non_deterministic(strict):
    from mvrecon.kernels.rays.cuda.operators import backproject

    views, lines = torch.zeros(1, 2, 1, 1), torch.zeros(2, 4, 3, 1)
    with pytest.raises(RuntimeError, match="explicit rays adds up in no fixed order"):
        backproject(views, lines, (0.0, 1.0), (2, 2, 2), "joseph")


@pytest.fixture
def threads():
    """Sets torch's number of threads for one test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_deterministic_training_has_the_same_bits_on_any_number_of_threads(
    tmp_path, strict, threads
):
    """Those that any training has on one thread."""
    settings = TrainSettings(**compose("experiment=smoke"))
    data = fit.build_data(settings)
    weights = []
    for number, deterministic in ((1, False), (1, True), (2, True), (3, True)):
        torch.use_deterministic_algorithms(False)
        threads(number)
        run = tmp_path / str(len(weights))
        fit.fit(
            "cross_view_small",
            replace(settings, trainer=settings.trainer | {"deterministic": deterministic}),
            data,
            run,
        )
        assert torch.get_num_threads() == number
        weights.append(
            trained.load_checkpoint(
                checkpoints.finished(run, "cross_view_small")
            ).module.state_dict()
        )
    assert torch.are_deterministic_algorithms_enabled()
    assert all(
        torch.equal(weights[0][name], other[name]) for other in weights[1:] for name in weights[0]
    )


@pytest.mark.parametrize("method", METHODS)
def test_volumes_and_gradients_have_the_same_bits_in_a_fixed_order(method, threads):
    settings = TrainSettings(
        **compose(f"method={method.partition(',')[0]}", *SMALL, *METHODS[method])
    )
    module = fit.build_module(settings, settings.method, 1.0)
    views, answers = torch.rand(2, 1, 4, 12, 12, generator=torch.Generator().manual_seed(0)), []
    for number in (1, 2, 3, 7):
        threads(number)
        module.zero_grad()
        with in_one_order():
            volume = module(views).volume
            volume.square().sum().backward()
        answers.append([volume, *[p.grad for p in module.parameters() if p.grad is not None]])
    assert all(
        torch.equal(a, b) for other in answers[1:] for a, b in zip(answers[0], other, strict=True)
    )


def test_the_compiled_loops_keep_a_fixed_order_of_threads(threads):
    threads(3)
    parts: list[tuple[int, int]] = []
    with in_one_order(), in_one_order():
        parallel_for(lambda first, last: parts.append((first, last)), 30, 2**20)
        assert torch.get_num_threads() == 1
    assert sorted(parts) == [(0, 10), (10, 20), (20, 30)] and torch.get_num_threads() == 3
    with in_one_order(wanted=False):
        assert torch.get_num_threads() == 3


@pytest.mark.parametrize(
    "method", [{"name": "sirt", "iterations": 4}, {"name": "backprojection"}], ids=["sirt", "bp"]
)
def test_methods_without_a_network_have_the_same_bits_on_any_number_of_threads(method, threads):
    settings = TrainSettings(**compose("grid.size=[40,40,40]"))
    module = fit.build_module(settings, method, 1.0)
    volumes = []
    for number in (1, 2, 3, 7):
        threads(number)
        volume = torch.rand(2, 1, 40, 40, 40, generator=torch.Generator().manual_seed(0))
        volumes.append(module(module.projector(volume)).volume)
    assert volumes[0].any() and all(torch.equal(volumes[0], other) for other in volumes[1:])
