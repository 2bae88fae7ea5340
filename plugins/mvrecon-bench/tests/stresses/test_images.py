"""The Jacobian of a frustum, which the stress plan follows towards the source."""

import pytest
import torch

import mvrecon as mv
from mvrecon.geometry.lattice import to_frustum
from mvrecon_bench.stresses.cases.cameras import frustum_jacobian

DETECTOR = {"pixels": [5, 7], "pixel_mm": [2.0, 3.0]}
CONE = mv.circular(3, 400.0, 800.0, DETECTOR)


@pytest.mark.parametrize("cameras", [CONE, mv.dcspect80()[[3, 50]], mv.parallel(3, DETECTOR)])
def test_the_jacobian_equals_that_of_autograd(cameras):
    f = 30.0
    xyz = torch.randn(4, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    claimed = frustum_jacobian(cameras, xyz.reshape(2, 2, 3), f)
    assert claimed.shape == (len(cameras), 2, 2)
    for m, H in enumerate(to_frustum(cameras, f)):

        def uvk(x, H=H):
            h = H @ torch.cat([x, x.new_ones(1)])
            return h[:3] / h[3]

        volumes = [torch.linalg.det(torch.autograd.functional.jacobian(uvk, x)).abs() for x in xyz]
        torch.testing.assert_close(claimed[m].flatten(), torch.stack(volumes), rtol=1e-9, atol=0)


def test_the_jacobian_of_a_straight_camera_is_f_fx_fy_over_z4():
    jacobian = frustum_jacobian(CONE, torch.tensor([[100.0, 5.0, -3.0]]), f=2.0)
    expected = torch.tensor([2 * (800 / 3) * (800 / 2) / 300.0**4], dtype=torch.float64)
    torch.testing.assert_close(jacobian[0], expected, rtol=1e-10, atol=0)
