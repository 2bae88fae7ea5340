"""What is made for a crop of the grid: its operator, its frusta, and how long they are kept."""

import copy
from dataclasses import replace

import pytest
import torch
from mvrecon.models.cropping import Cropping
from mvrecon.models.crops import cropped_geometry
from mvrecon.models.options import Options
from mvrecon.models.single_pass import SinglePass

from mvrecon.cameras.camera import VECTORS, Cameras
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.box import Box
from mvrecon.geometry.grid import Grid
from mvrecon.losses import ReconstructionLoss
from mvrecon.models import cropping, crops
from mvrecon.models.geometry import whole_geometry
from mvrecon.parts import CAMERAS, PROJECTORS
from mvrecon.projectors.ray_transform import RayTransform
from tests.models.rig import small_rig
from tests.models.test_support import _close, _with_mask


@torch.no_grad()
def test_few_crops_are_kept_and_made_once(projector, monkeypatch):
    kept = Cropping(projector, Options(support="hull"))
    monkeypatch.setattr(cropping, "KEPT", 2)
    boxes = [Box((0, 0, 0), (n, 8, 8)) for n in (4, 8, 12)]
    first = kept.crop(boxes[0])
    assert kept.crop(boxes[0]) is first
    kept.crop(boxes[1])
    kept.crop(boxes[0])
    kept.crop(boxes[2])
    assert [key[0] for key in kept.crops] == [boxes[0], boxes[2]]


def test_the_geometry_moves_with_its_module_and_its_maps_keep_their_digits(projector):
    whole = Cropping(projector, Options(), 3).double().whole
    assert whole.row.dtype == whole.column.dtype == whole.fine.step.dtype == torch.float64
    plain = Cropping(projector, Options(), 3).bfloat16().whole.coarse
    assert plain.step.dtype == torch.bfloat16 and plain.occupied.dtype == torch.bool
    assert torch.equal(plain.world_from_frusta, whole.coarse.world_from_frusta)
    gone = Cropping(copy.deepcopy(projector), Options(), 3).to("meta").whole
    tensors = (gone.row, gone.column, gone.cameras, gone.fine.edges, gone.coarse.occupied)
    assert all(tensor.is_meta for tensor in tensors)


def test_a_crop_is_the_operator_on_it(projector):
    box = Box((4, 8, 12), (16, 20, 24))
    x = torch.rand(1, 1, *box.shape)
    whole = torch.zeros(1, 1, 24, 24, 24)
    whole[..., *box.slices] = x
    crop = projector.cropped(box)
    assert _close(crop(x), projector(whole), 1e-5)
    views = torch.rand(1, 1, 4, 36, 36)
    assert _close(crop.T(views), projector.T(views)[..., *box.slices], 1e-5)
    geometry = cropped_geometry(whole_geometry(projector, 3), box)
    columns = projector.T(torch.ones(1, 1, 4, 36, 36))[..., *box.slices]
    assert torch.allclose(geometry.column * columns, torch.ones_like(columns), atol=1e-4)


@pytest.mark.parametrize("rig", ["circular", "dome", "parallel"])
def test_the_windows_of_a_crop_hold_all_that_its_inner_voxels_read(rig):
    grid, cameras = small_rig(size=24, pixels=36)
    detector = {"pixels": [36, 36], "pixel_mm": 1.0}
    if rig == "dome":
        cameras = CAMERAS.build(
            "dome", n_views=3, radius=90.0, focal=40.0, aperture_degrees=60.0, detector=detector
        )
    if rig == "parallel":
        cameras = CAMERAS.build("parallel", n_views=3, detector=detector)
    A = RayTransform(grid, cameras)
    whole, box = whole_geometry(A, 3), Box((8, 4, 12), (16, 12, 20))
    crop, inner = cropped_geometry(whole, box), (..., *[slice(1, -1)] * 3)
    mask = torch.zeros(1, 1, *grid.shape, dtype=torch.bool)
    mask[..., *box.slices][inner] = True
    smaller = 0
    for full, part in ((whole.fine, crop.fine), (whole.coarse, crop.coarse)):
        values = torch.rand(1, len(cameras), 1, *full.shape)
        index = [part.first[:, k, None] + torch.arange(n) for k, n in enumerate(part.shape)]
        z, v, u = index[0][:, :, None, None], index[1][:, None, :, None], index[2][:, None, None, :]
        m = torch.arange(len(cameras))[:, None, None, None]
        cut = values[0, m, 0, z, v, u][None, :, None]
        assert _close(
            part.to_world(cut)[inner], full.to_world(values)[..., *box.slices][inner], 1e-5
        )
        touched = full.touched(mask)[0, m, 0, z, v, u][None, :, None]
        assert torch.equal(part.touched(mask[..., *box.slices]), touched)
        assert touched.sum() == full.touched(mask).sum(), "touched bins were cut off"
        assert torch.equal(part.occupied[:, 0], full.occupied[m, 0, z, v, u])
        smaller += part.shape != full.shape
    assert smaller == 2


def test_touched_bins_are_those_that_hold_part_of_the_mask_and_no_others(projector):
    """A mask in frusta and back again loses no voxel of what was there, and is zero a bin and a
    voxel away from it.
    """
    fine = whole_geometry(projector, 3).fine
    mask = torch.zeros(1, 1, 24, 24, 24, dtype=torch.bool)
    mask[..., 11, 12, 13] = True
    touched = fine.touched(mask)
    held = fine.to_world(touched.float())
    assert torch.allclose(held[..., 11, 12, 13], torch.ones(1, 4, 1), atol=1e-5)
    far = torch.ones_like(mask)
    far[..., 8:15, 9:16, 10:17] = False
    assert not (held * far[:, None]).any() and touched.sum() < 4 * 100


def helix() -> tuple[Grid, Cameras]:
    """A tall grid, and a detector that climbs along it: no camera sees all of it."""
    grid = Grid.centred(size=(16, 16, 40), spacing=1.0)
    detector = {"pixels": [12, 24], "pixel_mm": 2.4}
    turns = [circular(1, 60.0, 100.0, detector, start_degrees=50.0 * k) for k in range(8)]
    lifted = [
        rig.moved(torch.eye(3), torch.tensor([0.0, 0.0, 4.5 * k - 15.75]))
        for k, rig in enumerate(turns)
    ]
    vectors = {name: torch.cat([getattr(rig, name) for rig in lifted]) for name in VECTORS}
    return grid, replace(lifted[0], **vectors)


def helical_model(shared: bool = True):
    torch.manual_seed(0)
    grid, cameras = helix()
    projector = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    opinion = {"width": 4, "features": 2, "binning": 3, "shared": shared}
    model = SinglePass(
        projector,
        {"name": "softmax_depth"},
        opinion,
        refine=4,
        start=3,
        consistency=1,
        support="hull",
    )
    for parameter in model.parameters():  # the last layers start from zero, and would hide the rest
        torch.nn.init.normal_(parameter, std=0.1)
    volume = torch.zeros(1, 1, *grid.shape)
    volume[..., 3:9, 4:12, 4:11] = torch.rand(6, 8, 7)
    return model, volume, projector(volume)


@pytest.mark.parametrize("shared", [True, False])
def test_cameras_that_see_nothing_of_the_crop_are_left_out_and_change_nothing(shared, monkeypatch):
    model, volume, views = helical_model(shared)
    batch = {"volume": volume, "views": views}

    def done():
        model.zero_grad()
        crop, out = model.cropping.region(views)[0], model(views)
        ReconstructionLoss(1.0, opinions=0.1, cross_view=0.01)(out, batch)["total"].backward()
        return (
            crop,
            out,
            [torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in model.parameters()],
        )

    crop, out, gradients = done()
    assert len(crop.A.cameras) == len(crop.cameras) <= 5
    model.cropping.crops.clear()
    monkeypatch.setattr(
        crops, "views_that_see", lambda cameras, grid: torch.ones(len(cameras)).bool()
    )
    dense, expected, others = done()
    assert len(dense.A.cameras) == len(dense.cameras) == 8
    for name in ("volume", "opinions", "weights", "cross_views", "start", "start_views"):
        assert _close(getattr(out, name), getattr(expected, name), 1e-5), name
    assert all(
        torch.allclose(a, b, rtol=1e-3, atol=1e-6) for a, b in zip(gradients, others, strict=True)
    )
    assert any(g.any() for g in gradients)


@torch.no_grad()
def test_frusta_end_at_the_mask_and_nothing_changes(monkeypatch):
    """A wall across the diagonal of its box, seen along itself."""
    torch.manual_seed(0)
    grid, detector = Grid.centred((32, 32, 32), 1.0), {"pixels": [48, 48], "pixel_mm": 1.0}
    A = PROJECTORS.build(
        "drr", grid=grid, cameras=circular(2, 90.0, 120.0, detector, angles=[40.0, 50.0])
    )
    model = SinglePass(
        A, {"name": "softmax_depth"}, {"width": 4}, refine=4, start=3, consistency=1, support="hull"
    )
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    y, x = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
    mask = torch.zeros(1, 1, *grid.shape, dtype=torch.bool)
    mask[..., 12:20, 4:28, 4:28] = ((y - x).abs() < 3)[4:28, 4:28]
    _with_mask(monkeypatch, mask)
    views = A(torch.rand(mask.shape) * mask)
    found, (narrow, _) = model(views), model.cropping.region(views)
    model.cropping.crops.clear()
    monkeypatch.setattr(cropping, "occupied_bricks", lambda mask: None)
    expected, (wide, _) = model(views), model.cropping.region(views)
    assert narrow.fine.step.numel() < wide.fine.step.numel()
    for field in ("volume", "opinions", "weights", "cross_views"):
        assert _close(getattr(found, field), getattr(expected, field), 1e-5), field
