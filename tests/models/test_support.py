"""Models that work on a support: what it may change, what it must not, and what it saves."""

import pytest
import torch
from torch.nn.functional import max_pool3d

from mvrecon.geometry.box import Box
from mvrecon.losses import ReconstructionLoss
from mvrecon.models import cropping
from mvrecon.models.pooling import disagreement
from mvrecon.parts import MODELS

HEAD = {"name": "softmax_depth"}
MODEL_OPTIONS = {
    "single_pass": {
        "head": HEAD,
        "opinion": {"width": 4},
        "refine": 4,
        "start": 3,
        "consistency": 1,
    },
    "mean_fusion": {"head": HEAD, "opinion": {"width": 4}, "start": 3, "consistency": 1},
    "backprojection_unet": {"width": 4, "start": 3, "consistency": 1},
}
NAMES = list(MODEL_OPTIONS)
FIELDS = ("volume", "opinions", "weights", "cross_views")


@pytest.fixture(scope="module")
def scenes(projector):
    """Two objects in different corners of the middle, their views, and masks a voxel wider."""
    torch.manual_seed(1)
    volume = torch.zeros(2, 1, 24, 24, 24)
    volume[0, 0, 9:12, 7:11, 9:13] = 1 + torch.rand(3, 4, 4)
    volume[1, 0, 11:14, 12:15, 8:11] = 1 + torch.rand(3, 3, 3)
    return volume, projector(volume), max_pool3d((volume > 0).float(), 3, stride=1, padding=1) > 0


def _build(
    name: str, projector: torch.nn.Module, dtype: torch.dtype = torch.float32, **options
) -> torch.nn.Module:
    torch.manual_seed(0)
    model = MODELS.build(name, projector, **{**MODEL_OPTIONS[name], **options}).to(dtype)
    torch.manual_seed(2)
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return model.eval()


def _with_mask(monkeypatch, mask: torch.Tensor) -> None:
    """As if the views told this mask."""
    monkeypatch.setattr(cropping, "hull_mask", lambda *_args, **_options: mask)


def _close(a: torch.Tensor, b: torch.Tensor, relative: float) -> bool:
    return bool(b.any()) and bool((a - b).abs().max() <= relative * b.abs().max())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_the_crop_does_not_matter_to_a_masked_model(name, dtype, projector, scenes, monkeypatch):
    _, views, mask = scenes
    _with_mask(monkeypatch, mask)
    models = [_build(name, projector, dtype, support="hull", halo=halo) for halo in (1, 5, 24)]
    found = [model(views.to(dtype)) for model in models]
    shapes = [next(iter(model.cropping.crops.values())).A.grid.shape for model in models]
    assert len(set(shapes)) == 3 and shapes[-1] == (24, 24, 24)
    for other in found[1:]:
        for field in FIELDS:
            one, two = getattr(found[0], field), getattr(other, field)
            assert (one is None and two is None) or _close(
                two, one, 1e-5 if dtype == torch.float32 else 1e-10
            )


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_sample_does_not_depend_on_the_others_of_its_batch(name, projector, scenes, monkeypatch):
    _, views, mask = scenes
    model, single = _build(name, projector, support="hull"), []
    for i in range(2):
        _with_mask(monkeypatch, mask[i : i + 1])
        single.append(model(views[i : i + 1]).volume)
    _with_mask(monkeypatch, mask)
    assert _close(model(views).volume, torch.cat(single), 1e-5)


@pytest.mark.parametrize("masked", [True, False])
@torch.no_grad()
def test_everything_returned_has_the_grid_and_is_zero_outside(
    masked, projector, scenes, monkeypatch
):
    volume, views, mask = scenes
    _with_mask(monkeypatch, mask)
    out = _build("single_pass", projector, support="hull", masked=masked)(views)
    assert torch.equal(out.support, mask) and out.visible.shape == (4, 1, 24, 24, 24)
    assert out.volume.shape == volume.shape and not (out.volume * ~mask).any() and out.volume.any()
    for field in (out.opinions, out.weights):
        assert field.shape == (2, 4, 1, 24, 24, 24) and not (field * ~mask[:, None]).any()
    seen = (out.visible & mask[:, None]).any(dim=1)
    assert torch.allclose(out.weights.sum(dim=1), seen.float(), atol=1e-6)


@torch.no_grad()
def test_cross_views_are_the_projected_opinions(projector, scenes, monkeypatch):
    _, views, mask = scenes
    _with_mask(monkeypatch, mask)
    out = _build("single_pass", projector, support="hull")(views)
    assert _close(out.cross_views[:, 1], projector(out.opinions[:, 1])[:, 0], 1e-4)


@pytest.mark.parametrize("kind", ["hull", "box", "auto"])
@torch.no_grad()
def test_the_support_of_real_views_holds_the_object(kind, projector, scenes):
    volume, views, _ = scenes
    out = _build("single_pass", projector, support=kind)(views)
    assert not (volume * ~out.support).any() and not out.support.all()
    if kind == "box":
        assert all(mask.sum() == Box.around(mask).size for mask in out.support)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_views_of_nothing_give_nothing(name, projector):
    out = _build(name, projector, support="hull")(torch.zeros(2, 1, 4, 36, 36))
    assert out.volume.shape == (2, 1, 24, 24, 24) and not out.volume.any() and not out.support.any()


@torch.no_grad()
def test_an_empty_scene_in_a_batch_leaves_the_other_alone(projector, scenes):
    _, views, _ = scenes
    model = _build("single_pass", projector, support="hull")
    both = model(torch.cat([views[:1], torch.zeros_like(views[:1])])).volume
    assert not both[1].any() and _close(both[:1], model(views[:1]).volume, 1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_weights_are_the_same_with_and_without(name, projector):
    off, on = _build(name, projector), _build(name, projector, support="hull")
    on.load_state_dict(off.state_dict())
    assert not any("crops" in key or "whole" in key for key in off.state_dict())


@torch.no_grad()
def test_a_support_of_everything_is_no_support_in_the_world(projector, scenes, monkeypatch):
    _, views, mask = scenes
    _with_mask(monkeypatch, torch.ones_like(mask))
    models = [
        _build("backprojection_unet", projector, torch.float64, support=kind)
        for kind in ("hull", "none")
    ]
    on, off = (model(views.double()) for model in models)
    assert off.support is None and _close(
        on.volume, off.volume, 1e-6
    )  # as exact as R, which is kept in float32


def test_auto_takes_everything_where_the_hull_holds_most_of_it():
    hull = torch.zeros(1, 1, 10, 10, 10, dtype=torch.bool)
    hull[..., 1:7, :, 0] = hull[..., 1, :, 9] = True
    assert torch.equal(cropping.support_of(hull, "auto"), hull)
    hull[..., 8, 5, 5] = True  # now its box holds 0.8 of the voxels
    assert cropping.support_of(hull, "auto").all() and torch.equal(
        cropping.support_of(hull, "hull"), hull
    )
    small = torch.zeros_like(hull)
    small[..., 2, 3:5, 7] = True
    both = torch.cat([hull, small])  # each by itself
    assert cropping.support_of(both, "auto")[0].all()
    assert torch.equal(cropping.support_of(both, "auto")[1:], small)
    assert torch.equal(cropping.support_of(both, "box")[1:], small)
    assert cropping.support_of(both, "box")[0].sum() == 8 * 10 * 10
    assert not cropping.support_of(torch.zeros_like(hull), "box").any()


def test_every_parameter_learns_on_a_support_met_first_in_evaluation(
    projector, scenes, monkeypatch
):
    volume, views, mask = scenes
    _with_mask(monkeypatch, mask)
    model = _build("single_pass", projector, support="hull")
    with torch.inference_mode():
        model(views)
    out = model.train()(views)
    ReconstructionLoss(1.0, edges=0.1, opinions=0.1, cross_view=0.01)(
        out, {"volume": volume, "views": views}
    )["total"].backward()
    assert not [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert len(model.cropping.crops) == 1


def test_disagreement_is_bricks_and_those_around_them():
    spread = torch.zeros(2, 1, 16, 16, 18)
    spread[0, 0, 9, 1, 17] = 0.2
    near = disagreement(spread, 0.1)
    expected = torch.zeros(2, 1, 16, 16, 18, dtype=torch.bool)
    expected[0, 0, 4:16, 0:8, 12:18] = True
    assert torch.equal(near, expected) and not disagreement(spread, 0.3).any()


#: A tolerance that the opinions' spread passes in some bricks and not in others.
MIDDLE = {"none": 0.3, "hull": 0.1}


@pytest.mark.parametrize("support", ["none", "hull"])
@torch.no_grad()
def test_refinement_where_opinions_disagree(support, projector, scenes, monkeypatch):
    _, views, mask = scenes
    _with_mask(monkeypatch, mask)
    options = {"support": support, "consistency": 0}
    plain = _build("single_pass", projector, refine=0, **options)
    volumes = {}
    for tolerance in (1e-9, MIDDLE[support], 1e9):
        model = _build(
            "single_pass", projector, refine_where="disagreement", tolerance=tolerance, **options
        )
        plain.load_state_dict(model.state_dict(), strict=False)
        volumes[tolerance] = model(views).volume
    unrefined = plain(views).volume
    changed = {key: (volume != unrefined).float().mean().item() for key, volume in volumes.items()}
    assert torch.equal(volumes[1e9], unrefined) and 0 < changed[MIDDLE[support]] <= changed[1e-9]
    assert support == "hull" or changed[MIDDLE[support]] < changed[1e-9]


@torch.no_grad()
def test_steps_stop_for_each_sample_where_noise_explains_what_is_left(projector, scenes):
    volume, views, _ = scenes
    model = _build("backprojection_unet", projector, consistency=3)
    geometry = model.cropping.whole
    start = torch.cat([volume[:1] * 1.001, volume[1:] * 0.5])
    sigma = 0.01 * views.square().mean().sqrt().expand(2, 1, 1, 1, 1)
    after = model.consistency(geometry, start, views, sigma)
    assert torch.equal(after[0], start[0]) and not torch.equal(after[1], start[1])
    assert torch.equal(
        model.consistency(geometry, start, views, sigma / 1e6),
        model.consistency(geometry, start, views),
    )
    always = model.train().consistency(geometry, start, views, sigma)
    assert torch.equal(always, model.consistency(geometry, start, views))


def test_losses_count_what_is_in_the_support(projector, scenes, monkeypatch):
    volume, views, mask = scenes
    _with_mask(monkeypatch, mask)
    with torch.no_grad():
        out = _build("single_pass", projector, support="hull")(views)
    loss = ReconstructionLoss(1.0, edges=1.0, opinions=0.1, cross_view=0.01)
    terms = loss(out, {"volume": volume, "views": views})
    error = (out.volume - volume)[mask]
    assert terms["volume"].item() == pytest.approx(error.square().mean().item(), rel=1e-4)
    outside = loss(out, {"volume": volume + 5.0 * ~mask, "views": views})
    assert all(torch.equal(outside[name], terms[name]) for name in ("volume", "edges", "opinions"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"support": "hulk"}, "support must be one of"),
        ({"refine_where": "some"}, "refine_where must be one of"),
        ({"halo": 0}, "halo of at least one"),
        ({"sigma": 0.0}, "sigma must be positive"),
    ],
)
def test_unknown_choices_are_refused(options, said, projector):
    with pytest.raises(ValueError, match=said):
        _build("backprojection_unet", projector, **options)


@pytest.mark.parametrize(
    ("name", "typed", "meant"),
    [
        ("single_pass", "suport", "support"),
        ("single_pass", "fusoin", "fusion"),
        ("mean_fusion", "consistancy", "consistency"),
        ("backprojection_unet", "widht", "width"),
    ],
)
def test_a_mistyped_option_is_named_with_the_nearest_of_all_that_the_model_has(
    name, typed, meant, projector
):
    with pytest.raises(TypeError, match=f"no option '{typed}'; did you mean '{meant}'") as error:
        _build(name, projector, **{typed: 1})
    own = {"single_pass": "fusion", "mean_fusion": "opinion", "backprojection_unet": "width"}
    assert all(option in str(error.value) for option in (own[name], "start", "support", "sigma"))
    assert ("fusion" in str(error.value).split("Known:")[1]) == (name == "single_pass")


def test_a_model_that_refines_nothing_refuses_to_choose_where(projector):
    for name in ("mean_fusion", "backprojection_unet"):
        with pytest.raises(ValueError, match="refine_where"):
            _build(name, projector, refine_where="disagreement")
