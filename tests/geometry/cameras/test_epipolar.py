"""What is on the ray of a pixel of one camera is seen on that pixel's line in another."""

import pytest
import torch

import mvrecon as mv

DETECTOR = {"pixels": [40, 48], "pixel_mm": 2.0, "offset_mm": [3.0, -5.0]}
RIGS = {
    "cone": mv.arc(6, 400.0, 800.0, DETECTOR),
    "parallel": mv.parallel(5, DETECTOR, start_degrees=11.0),
    "pinholes": mv.dcspect80(pixels=[16, 16])[[0, 17, 40]],
}


@pytest.mark.parametrize("name", RIGS)
def test_points_of_a_ray_are_on_the_epipolar_line(name: str):
    cameras = RIGS[name]
    start, end = cameras.rays()
    pixels = torch.tensor([[0, 0], [5, 9], [15, 3]])
    for first, second in ((0, 1), (2, 0)):
        lines = mv.epipolar_line(cameras, first, second, pixels.double())
        assert torch.allclose(lines[:, :2].norm(dim=1), torch.ones(3, dtype=torch.float64))
        low, high = (max(-2.0, min(2.0, w)) for w in cameras.ray_extent)
        for w in torch.linspace(low, high, 5)[1:-1].tolist():
            along = (1 - w) * start[first] + w * end[first]
            points = along[pixels[:, 1], pixels[:, 0]]
            uv = cameras[second].project(points)[0, :, :2]
            miss = (lines[:, :2] * uv).sum(dim=1) + lines[:, 2]
            assert miss.abs().max() < 1e-7 * (1 + uv.abs().max()), f"{w}: {miss}"


def test_two_cameras_at_the_same_position_have_no_epipolar_lines():
    with pytest.raises(ValueError, match="Cameras 1 and 1 are at one place"):
        mv.epipolar_line(RIGS["cone"], 1, 1, torch.zeros(1, 2))
