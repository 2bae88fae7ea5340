"""The model in rounds: its start, its hull, its symmetries, and what its cameras correct."""

import io
from dataclasses import replace

import pytest
import torch
import yaml
from mvrecon.models.cross_view.model import CrossView

from mvrecon.config import conf_dir
from mvrecon.geometry.grid import Grid
from mvrecon.losses import EARLIER, ReconstructionLoss
from mvrecon.models.output import Reconstruction
from mvrecon.parts import CAMERAS, PROJECTORS
from mvrecon.reconstructors.iterative import SirtWeights, sirt, sirt_weights
from mvrecon.testing import check_model
from tests.models.rig import small_projector, small_rig

SMALL = {
    "CM3": [
        {"widths": [4, 6], "cameras": {"name": "rays2d", "widths": [4, 6], "depths": 4}},
        {"widths": [4], "resolution": "full"},
    ],
    "M3": [{"widths": [4, 6]}, {"widths": [4, 6], "resolution": "full"}],
    "K": [
        {"widths": [4], "cameras": {"name": "rays2d", "widths": [4]}},
        {"widths": [4], "cameras": {"name": "rays2d", "widths": [6]}},
    ],
}


def stirred(projector, rounds="CM3", **options) -> CrossView:
    """With random weights everywhere."""
    torch.manual_seed(2)
    model = CrossView(projector, SMALL[rounds], **options).eval()
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return model


def blob(projector, samples: int = 1) -> torch.Tensor:
    torch.manual_seed(1)
    volume = torch.zeros(samples, 1, *projector.grid.shape)
    volume[..., 3:9, 4:8, 3:8] = 0.5 + torch.rand(samples, 1, 6, 4, 5)
    return volume


@pytest.mark.parametrize("rounds", SMALL)
@pytest.mark.parametrize("support", ["none", "hull"])
@pytest.mark.filterwarnings("ignore:Rays are up to")
def test_every_choice_of_rounds_keeps_the_contract(rounds, support):
    check_model("cross_view", small_projector(), rounds=SMALL[rounds], support=support)


def test_the_presets_have_as_many_weights_as_in_the_docs():
    projector, counts = small_projector(), []
    for name in ("cross_view", "cross_view_frustum3d", "world_rounds", "world_unet"):
        options = yaml.safe_load((conf_dir() / "model" / f"{name}.yaml").read_text())
        kept = {key: value for key, value in options.items() if key not in ("name", "defaults")}
        model = CrossView(projector, **kept)
        counts.append(round(sum(p.numel() for p in model.parameters()) / 1e6, 2))
    assert counts == [0.52, 0.51, 1.77, 0.51]


def test_before_training_a_round_is_a_step_of_sirt():
    """What networks change or correct starts at zero, and every step has length one; short chords
    count as a tenth of the longest.
    """
    projector = small_projector()
    views = projector(blob(projector))
    model = CrossView(projector, SMALL["CM3"], start=3, consistency=2)
    row, column = sirt_weights(projector)
    weights = SirtWeights(row.clamp_max(10 * row[row > 0].min()), column)
    expected = sirt(projector, views, 3, momentum=True, weights=weights)
    expected = sirt(projector, views, 4, nonnegative=False, start=expected, weights=weights)
    expected = expected.clamp_min(0)
    volume = model(views).volume
    assert (volume - expected).abs().max() < 1e-5 * expected.abs().max()


@torch.no_grad()
def test_nothing_depends_on_the_order_of_the_cameras():
    grid, cameras = small_rig()
    order = torch.tensor([2, 0, 3, 1])
    turned = PROJECTORS.build("drr", grid=grid, cameras=cameras[order])
    projector = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    views = projector(blob(projector))
    volume = stirred(projector)(views).volume
    permuted = stirred(turned)(views[:, :, order]).volume
    assert (permuted - volume).abs().max() < 1e-5 * volume.abs().max()


@pytest.mark.parametrize("name", ["rays2d", "frustum3d"])
def test_weights_fit_a_rig_and_a_detector_of_any_size(name):
    """Cells may stand beyond the detector; pixels there are none, and change nothing."""
    cameras = {"name": name, "widths": [4, 6], "depths": 4}
    rounds = [{"widths": [4, 6], "cameras": cameras}]
    other = small_projector(3, pixels=11)
    check_model("cross_view", other, rounds=rounds)
    model = CrossView(other, rounds)
    model.load_state_dict(CrossView(small_projector(4, size=10), rounds).state_dict())


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_outside_the_hull_all_rounds_are_zero_and_inside_not():
    projector = small_projector()
    out = stirred(projector, support="hull")(projector(blob(projector, 2)))
    assert out.support is not None and 0 < out.support.float().mean() < 1
    for volume in (out.volume, out.start, *out.earlier):
        assert not (volume * ~out.support).any() and volume.any()


@pytest.mark.filterwarnings("ignore:Rays are up to")
@pytest.mark.parametrize("support", ["none", "hull"])
@torch.no_grad()
def test_no_ray_is_weighted_by_less_than_a_tenth_of_the_longest_chord(support):
    """What an overexposed view reads where rays graze the region would be all of the loss."""
    projector = small_projector()
    model = CrossView(projector, SMALL["M3"], support=support)
    geometry = model._geometry(projector(blob(projector, 2)))
    region = torch.ones(1, 1, 12, 12, 12) if geometry.mask is None else geometry.mask.float()
    chords = projector(region)
    longest = chords.amax(dim=(1, 2, 3, 4), keepdim=True)
    expected = torch.where(chords > 0, 1 / chords.maximum(0.1 * longest), 0.0)
    assert ((chords > 0) & (chords < 0.1 * longest)).any()
    assert torch.allclose(geometry.row, expected, rtol=1e-5)


@pytest.mark.filterwarnings("ignore:Rays are up to")
@pytest.mark.parametrize("support", ["hull", "box", "auto"])
def test_a_sample_of_nothing_has_an_empty_hull_and_spoils_no_gradient(support):
    projector = small_projector()
    truth = blob(projector, 2)
    truth[1] = 0
    model = stirred(projector, support=support)
    volume = model(projector(truth)).volume
    assert volume[0].any() and not volume[1].any()
    volume.square().sum().backward()
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


@torch.no_grad()
def test_rays_that_miss_the_grid_are_not_corrected():
    grid, cameras = small_rig()
    wide = replace(cameras, u=3 * cameras.u, origin=cameras.origin - 11 * cameras.u)
    projector = PROJECTORS.build("drr", grid=grid, cameras=wide)
    views = projector(blob(projector)) + 0.01
    (corrected,) = stirred(projector)(views).corrected_views
    missing = (projector(torch.ones(1, 1, 12, 12, 12)) == 0).expand_as(views)
    assert missing.any() and torch.equal(corrected[missing], views[missing])
    assert (corrected != views)[~missing].any()


def test_every_round_but_the_last_is_handed_to_the_loss_and_every_correction():
    projector = small_projector()
    views = projector(blob(projector))
    outs = {name: stirred(projector, name)(views) for name in SMALL}
    assert [len(out.earlier) for out in outs.values()] == [1, 1, 1]
    assert [len(out.corrected_views) for out in outs.values()] == [1, 0, 2]


def test_corrections_learn_from_the_truth_s_own_views_alone():
    """The term is zero where views are A x_true, whatever the volume; its gradient reaches the
    cameras' network and no network in the world."""
    projector = small_projector()
    truth = blob(projector)
    model, views = stirred(projector), 1.05 * projector(truth)
    loss = ReconstructionLoss(1.0, corrected_views=10.0)
    batch = {"volume": truth, "views": views, "true_views": projector(truth)}
    out = model(views)
    perfect = replace(out, corrected_views=(batch["true_views"],))
    assert float(loss(perfect, batch)["corrected_views"]) == 0
    loss(out, batch)["corrected_views"].backward()
    assert all(p.grad is not None for p in model.rounds[0].cameras.parameters())
    assert all(p.grad is None for p in model.rounds[0].world.parameters())


def test_the_correction_term_is_a_mean_density_and_earlier_rounds_count_less():
    truth, row = torch.zeros(1, 1, 12, 12, 12), torch.full((1, 1, 4, 12, 12), 0.5)
    views = torch.zeros(1, 1, 4, 12, 12)
    earlier = tuple(torch.full_like(truth, value) for value in (3.0, 2.0))
    out = Reconstruction(truth, earlier=earlier, corrected_views=(views + 4.0,), row=row)
    loss = ReconstructionLoss(2.0, rounds=1.0, corrected_views=10.0)
    terms = loss(out, {"volume": truth, "views": views, "true_views": views})
    assert float(terms["corrected_views"]) == pytest.approx(1.0)  # (0.5 * 4 / 2)^2
    expected = EARLIER * (2 / 2) ** 2 + EARLIER**2 * (3 / 2) ** 2
    assert float(terms["rounds"]) == pytest.approx(expected)
    assert float(terms["total"]) == pytest.approx(expected + 10)
    assert set(ReconstructionLoss(2.0)(out, {"volume": truth, "views": views})) == {
        "volume",
        "total",
    }


def test_a_few_steps_teach_the_cameras_what_the_grid_would_have_measured():
    """Views 5 % too bright: their corrections end nearer to A x_true than the views are."""
    projector = small_projector()
    truth = blob(projector)
    true_views = projector(truth)
    views = 1.05 * true_views
    torch.manual_seed(0)
    model = CrossView(projector, SMALL["CM3"])
    loss = ReconstructionLoss(1.0, volume=0.0, corrected_views=10.0)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    batch, errors = {"volume": truth, "views": views, "true_views": true_views}, []
    for _ in range(25):
        terms = loss(model(views), batch)
        errors.append(float(terms["corrected_views"].detach()))
        optimizer.zero_grad()
        terms["total"].backward()
        optimizer.step()
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.parametrize(("pixels", "edge"), [(12, 3), (8, 3), (2, 2)])
def test_pixels_are_joined_on_a_detector_that_has_as_many(pixels, edge):
    projector = small_projector(pixels=pixels)
    model = stirred(projector)
    assert model.rounds[0].cameras.binning == edge
    assert model(projector(blob(projector))).volume.isfinite().all()


def test_weights_come_back_from_a_file():
    projector = small_projector()
    views, model, other = projector(blob(projector)), stirred(projector), stirred(projector, "CM3")
    for parameter in other.parameters():
        parameter.data.zero_()
    file = io.BytesIO()
    torch.save(model.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file))
    assert torch.equal(other(views).volume, model(views).volume)


def test_parallel_beams_have_rays_too():
    grid = Grid.centred((8, 8, 8), 2.0)
    detector = {"pixels": [9, 9], "pixel_mm": 3.0}
    cameras = CAMERAS.build("parallel", n_views=3, detector=detector)
    projector = PROJECTORS.build("radon", grid=grid, cameras=cameras)
    volume = stirred(projector)(projector(torch.rand(1, 1, 8, 8, 8))).volume
    assert volume.isfinite().all() and volume.any()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"rounds": []}, ValueError, "at least one round"),
        ({"rounds": [{"resolution": "double"}]}, ValueError, "quarter, half, full, got 'double'"),
        ({"rounds": [{"widths": []}]}, ValueError, "widths of a round"),
        ({"rounds": [{"width": 3}]}, TypeError, "no option 'width'; did you mean 'widths'"),
        ({"rounds": [{"cameras": {"name": "ray2d"}}]}, LookupError, "did you mean 'rays2d'"),
        ({"precision": "half"}, ValueError, "float32 or auto, got .*'half'"),
        ({"support": "cone"}, ValueError, "support must be one of"),
        (
            {
                "rounds": [
                    {"cameras": {"name": "rays2d"}},
                    {"cameras": {"name": "rays2d", "memory": 3}},
                ]
            },
            ValueError,
            "equal binning and memory",
        ),
    ],
)
def test_rounds_that_make_no_sense_are_refused(options, error, message):
    """Options of a model's rounds that do not exist, or do not fit one another, are refused."""
    with pytest.raises(error, match=message):
        CrossView(small_projector(), **options)


def test_views_of_counts_are_not_corrected_where_all_is_empty():
    """What a network adds beside the object would come back as activity there."""
    projector = small_projector()
    views = projector(blob(projector))
    empty, exact = views == 0, stirred(projector)(views).corrected_views[-1]
    counted = stirred(projector, consistency={"steps": 2, "noise": "poisson"})(views)
    assert exact[empty].abs().max() > 0 and not counted.corrected_views[-1][empty].any()
    within = views > 0.2 * views.max()
    assert torch.equal(counted.corrected_views[-1][within], exact[within])
