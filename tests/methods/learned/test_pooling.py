import torch

from mvrecon.methods.learned.view_frames import fuse, leave_one_out, pooled


def _volumes(m: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    return torch.randn(2, m, 3, 4, 4, 4) + 100.0, torch.rand(m, 1, 4, 4, 4) > 0.4


def test_leave_one_out_equals_pooling_the_others():
    volumes, visible = _volumes()
    mean, variance, count = leave_one_out(volumes, visible)
    for k in range(5):
        others = [j for j in range(5) if j != k]
        expected, spread = pooled(volumes[:, others], visible[others])
        assert torch.allclose(mean[:, k], expected[:, 0], rtol=1e-5)
        assert torch.allclose(variance[:, k], spread[:, 0], atol=1e-3)
        assert torch.equal(count[k], visible[others].sum(dim=0).float())


def test_a_single_camera_has_no_others():
    volumes, visible = _volumes(1)
    mean, variance, count = leave_one_out(volumes, visible)
    assert not mean.any() and not variance.any() and not count.any()


def test_fusion_is_a_convex_sum_over_the_cameras_that_see_a_voxel():
    volumes, visible = _volumes()
    volumes = volumes[:, :, :1]
    fused, weights = fuse(volumes, torch.randn_like(volumes), visible)
    seen = visible.any(dim=0)
    assert torch.allclose(weights.sum(dim=1), seen.expand(2, 1, 4, 4, 4).float(), atol=1e-6)
    assert not (weights * ~visible).any()
    assert not fused[~seen.expand_as(fused)].any()
    low = torch.where(visible, volumes, torch.inf).amin(dim=1)
    high = torch.where(visible, volumes, -torch.inf).amax(dim=1)
    inside = seen.expand_as(fused)
    assert (fused[inside] >= low[inside] - 1e-3).all() and (
        fused[inside] <= high[inside] + 1e-3
    ).all()


def test_fusion_with_zero_logits_is_the_mean():
    volumes, visible = _volumes()
    fused, _ = fuse(volumes[:, :, :1], torch.zeros_like(volumes[:, :, :1]), visible)
    assert torch.allclose(fused, pooled(volumes[:, :, :1], visible)[0][:, 0], rtol=1e-5)
