import pytest
import torch

from mvrecon.cameras.camera import Cameras
from mvrecon.losses import ReconstructionLoss
from mvrecon.parts import MODELS, PROJECTORS
from mvrecon.projectors.operator import Scaled
from tests.models.rig import small_projector, small_rig

HEAD = {"name": "softmax_depth"}
OPTIONS = {"single_pass": {"head": HEAD}, "mean_fusion": {"head": HEAD}}


def _build(name: str, projector: torch.nn.Module, **options) -> torch.nn.Module:
    torch.manual_seed(0)
    return MODELS.build(name, projector, **OPTIONS.get(name, {}), **options)


def _blob_views(projector: torch.nn.Module) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    volume = torch.zeros(2, 1, *projector.grid.shape)
    volume[..., 3:9, 4:8, 3:8] = torch.rand(2, 1, 6, 4, 5)
    return volume, projector(volume)


def _close(a: torch.Tensor, b: torch.Tensor, relative: float) -> bool:
    """Whether two tensors agree to within a fraction of the greater one's maximum."""
    return bool((a - b).abs().max() <= relative * b.abs().max())


def _stir(model: torch.nn.Module) -> None:
    """Random weights everywhere, so that layers which start at zero take part."""
    torch.manual_seed(2)
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)


def test_opinions_reproduce_their_own_views():
    projector = small_projector()
    model = _build("single_pass", projector)
    _stir(model.opinions)
    _, views = _blob_views(projector)
    seen: list[torch.Tensor] = []
    model.opinions.head.register_forward_hook(lambda _module, _given, density: seen.append(density))
    model.opinions(
        model.cropping.whole, views, torch.rand(2, 1, 12, 12, 12), torch.zeros_like(views)
    )
    fine = model.cropping.whole.fine
    sees = fine.chord.reshape(1, 1, 4, 12, 12) > 0
    assert _close(fine.integrate(seen[0]), views * sees, 1e-5)


def test_counts_are_placed_along_rays_as_the_integrals_that_they_are_of():
    """Pixels of any sensitivity: the opinions are those of the line integrals, but for R y times
    the chord, where thin rays and the frusta's bins differ at the edge of the grid.
    """
    projector = small_projector()
    _, views = _blob_views(projector)
    weight = 1e-4 * torch.linspace(0.5, 1, views[0, 0].numel()).reshape(views.shape[2:])
    volumes = []
    for A, measured in ((projector, views), (Scaled(projector, pixels=weight), weight * views)):
        model = _build("mean_fusion", A, opinion={"prior": "uniform"}, start=1, consistency=0)
        volumes.append(model(measured).volume)
    assert (volumes[1] - volumes[0]).norm() < 0.05 * volumes[0].norm()


class _Unmoved(torch.nn.Module):
    """A head that has nothing to add to the prior."""

    def forward(self, logits, prior, views, frusta):
        return prior * frusta.occupied


def test_what_the_cameras_do_not_change_is_not_blurred_by_their_warps():
    projector = small_projector()
    model = _build("single_pass", projector)
    model.opinions.head = _Unmoved()
    volume, views = _blob_views(projector)
    said, _ = model.opinions(model.cropping.whole, views, volume, torch.zeros_like(views))
    assert torch.equal(said, volume[:, None].expand_as(said))


def test_permuting_the_cameras_changes_nothing():
    grid, cameras = small_rig()
    order = [2, 0, 3, 1]
    volumes = []
    for rig, index in ((cameras, [0, 1, 2, 3]), (cameras[order], order)):
        projector = PROJECTORS.build("drr", grid=grid, cameras=rig)
        model = _build("single_pass", projector)
        _stir(model)
        _, views = _blob_views(PROJECTORS.build("drr", grid=grid, cameras=cameras))
        volumes.append(model(views[:, :, index]).volume)
    assert _close(*volumes, 1e-4)


def test_cross_views_are_the_projected_opinions():
    projector = small_projector()
    out = _build("single_pass", projector)(_blob_views(projector)[1])
    expected = projector(out.opinions[:, 1])[:, 0, 3]
    assert _close(out.cross_views[:, 1, 3], expected, 1e-4)


def test_consistency_steps_bring_the_volume_towards_the_views():
    projector = small_projector()
    volume, views = _blob_views(projector)
    model = _build("backprojection_unet", projector, consistency=5)
    before = volume * 0.5
    after = model.consistency(model.cropping.whole, before, views)
    misfit = [(projector(x) - views).norm() for x in (before, after)]
    assert misfit[1] < 0.5 * misfit[0]


def test_separate_networks_for_every_camera():
    projector = small_projector()
    shared = _build("single_pass", projector)
    separate = _build("single_pass", projector, opinion={"shared": False})
    count = [sum(p.numel() for p in m.opinions.nets.parameters()) for m in (shared, separate)]
    assert count[1] == 4 * count[0]
    assert separate(_blob_views(projector)[1]).volume.isfinite().all()


def test_without_a_depth_network_every_depth_is_equally_likely():
    projector = small_projector()
    model = _build("single_pass", projector, opinion={"prior": "uniform"})
    _, views = _blob_views(projector)
    frusta = model.cropping.whole.fine
    out = model(views)
    assert _close(out.opinions, frusta.to_world(frusta.spread(views)), 1e-4)
    assert not list(model.opinions.parameters())


def test_every_parameter_of_single_pass_learns():
    projector = small_projector()
    model = _build("single_pass", projector)
    _stir(model)
    volume, views = _blob_views(projector)
    loss = ReconstructionLoss(1.0, edges=0.1, opinions=0.1, cross_view=0.01)(
        model(views), {"volume": volume, "views": views}
    )
    loss["total"].backward()
    idle = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert not idle and set(loss) == {"volume", "edges", "opinions", "cross_view", "total"}


@pytest.mark.parametrize("options", [{"fusion": "median"}, {"opinion": {"prior": "learnt"}}])
def test_unknown_options_are_refused(options):
    with pytest.raises(ValueError, match="got"):
        _build("single_pass", small_projector(), **options)


def test_cameras_may_be_few():
    grid, cameras = small_rig()
    assert isinstance(cameras[[0]], Cameras)
    projector = PROJECTORS.build("drr", grid=grid, cameras=cameras[[0]])
    model = _build("single_pass", projector)
    assert model(_blob_views(projector)[1]).volume.isfinite().all()


#: Of models with random weights, from before they could skip anything: the sum and mean square of
#: the volume, two of its voxels, and the loss.
BEFORE = {
    "single_pass": (127.037872, 0.022079, 0.491416, 0.457261, 0.013639),
    "mean_fusion": (125.413834, 0.014192, 0.461284, 0.177629, 0.00994),
    "backprojection_unet": (129.599121, 0.043415, 0.589954, 0.254898, 0.031239),
}


@pytest.mark.parametrize("name", BEFORE)
def test_models_that_skip_nothing_answer_as_they_did(name):
    projector = small_projector()
    model = _build(name, projector)
    _stir(model)
    if (
        name != "backprojection_unet"
    ):  # these weights are from when the depth network saw views in mm
        model.opinions.pixels.weight.data *= model.opinions.unit
    volume, views = _blob_views(projector)
    out = model(views)
    loss = ReconstructionLoss(1.0, edges=0.1, opinions=0.1, cross_view=0.01)(
        out, {"volume": volume, "views": views}
    )["total"]
    x = out.volume
    found = (x.sum(), x.square().mean(), x[0, 0, 5, 6, 5], x[1, 0, 8, 4, 3], loss)
    assert [value.item() for value in found] == pytest.approx(BEFORE[name], rel=1e-3)
