"""A rig as lines and rods: they lie where the rays, detectors and the grid are."""

import pytest
import torch

import mvrecon as mv
from mvrecon.report.viz.rig import LINE_WIDTH, mesh, segments

GRID = mv.Grid.centred(size=(16, 12, 8), spacing=(2.0, 2.0, 3.0))
DETECTOR = {"pixels": [6, 8], "pixel_mm": 5.0}


def test_detectors_rays_and_the_grid_have_their_lengths():
    parts = segments(mv.circular(5, 200.0, 300.0, DETECTOR), GRID)
    lengths = {name: (s[:, 1] - s[:, 0]).norm(dim=1) for name, s in parts.items()}
    assert lengths["grid"].sum().item() == 4 * (16 * 2 + 12 * 2 + 8 * 3)
    frame = torch.tensor([40.0, 30.0, 40.0, 30.0], dtype=torch.float64)
    torch.testing.assert_close(lengths["view 0"][:4], frame)
    torch.testing.assert_close(lengths["rays"][4:], torch.full((4,), 300.0, dtype=torch.float64))


def test_rays_of_a_pinhole_go_through_it_to_the_far_side_of_the_grid():
    rig = mv.dcspect80(pixels=[8, 8])
    rays = segments(rig, GRID)["rays"]
    assert (rig.project(rays[:4, 1])[0, :, 2] < 0).all()  # behind pinhole 0
    away = (rays[4:, 0] - GRID.centre).norm(dim=1)
    assert ((rays[4:, 1] - rays[4:, 0]).norm(dim=1) > away).all()


def test_rods_are_closed_around_their_lines():
    parts = segments(mv.parallel(3, DETECTOR), GRID)
    rods = mesh(parts)
    ends = torch.cat(list(parts.values()))
    size = (ends.flatten(0, 1).amax(0) - ends.flatten(0, 1).amin(0)).max()
    apart = (rods.vertices.view(-1, 2, 3, 3) - ends[:, :, None]).norm(dim=-1)
    torch.testing.assert_close(apart, (LINE_WIDTH / 2 * size).expand_as(apart))
    assert len(rods.colours) == len(rods.vertices) == 6 * len(ends)
    # every vertex is of two or more faces, none of another rod
    assert rods.faces.flatten().bincount().min() >= 2
    assert (rods.faces // 6 == rods.faces[:, :1] // 6).all()


@pytest.mark.parametrize("pixel", [1e-3, 1.0, 1e3])
def test_parallel_beams_without_an_end_are_drawn_to_scale_with_their_grid(pixel):
    """Pixels of a micrometre were dots half a metre from the grid. The lines stay those of the rig,
    on the same side of it.
    """
    rig = mv.parallel(5, {"pixels": [8, 16], "pixel_mm": pixel, "offset_mm": [0, pixel]})
    grid = mv.Grid.centred(8, spacing=pixel, centre=(0, pixel, 0))
    parts = segments(rig, grid)
    assert 16 * pixel < torch.cat(list(parts.values())).abs().max() < 64 * pixel
    start, end = rig.rays()
    way = end[0, 0, 0] - start[0, 0, 0]
    rays = parts["rays"][:4]
    drawn = rays[:, 1] - rays[:, 0]
    assert torch.allclose(drawn / drawn.norm(dim=1, keepdim=True), way / way.norm())
    aside = torch.linalg.cross(rays[0, 0] - start[0, 0, 0], way / way.norm())
    assert aside.norm() == pytest.approx(pixel / 2**0.5, rel=1e-5)  # the first pixel's corner
