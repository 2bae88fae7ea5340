"""Attenuated rays: exact where attenuation is constant, matched, and free where there is none."""

import gc
import math

import pytest
import torch

from mvrecon.geometry.cameras.rigs import dcspect80, parallel
from mvrecon.geometry.grid import Box, Grid, voxel_centres
from mvrecon.kernels.rays.cpu.skip_policy import box_of
from mvrecon.operators.drr import Drr
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon_spect import attenuated
from mvrecon_spect.attenuated import AttenuatedTransform
from mvrecon_spect.kernels import cpu

MU = 0.01536


def rig(pixels=(7, 9)):
    return dcspect80(pixels=list(pixels), columns=[0, 7, 13], rows=[0, 2])


def scene(dtype=torch.float64):
    torch.manual_seed(0)
    grid = Grid.centred(size=(12, 10, 9), spacing=12.0)
    mu = 0.03 * torch.rand(grid.shape, dtype=dtype)
    mu[2] *= 3  # beyond the series
    return grid, mu, torch.rand(1, 2, *grid.shape, dtype=dtype)


def test_a_uniform_box_gives_the_closed_form_along_every_ray_and_siddon_is_exact():
    grid = Grid.centred(10, spacing=15.0)
    ones = torch.ones(1, 1, *grid.shape, dtype=torch.float64)
    length = Drr(grid, rig(), method="siddon")(ones)
    A = AttenuatedTransform(grid, rig(), MU * ones[0, 0], method="siddon")
    torch.testing.assert_close(A(ones), -torch.expm1(-MU * length) / MU, rtol=1e-12, atol=1e-12)


def test_counts_are_weakened_on_their_way_to_the_pinhole_and_not_behind():
    grid = Grid.centred(size=(20, 5, 5), spacing=10.0)
    camera = dcspect80(pixels=1, columns=[0], rows=[0])  # pinhole on the side of +x
    x = torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    x[..., 2, 2, 9:11] = 1
    near, far = torch.zeros(2, *grid.shape, dtype=torch.float64)
    near[..., 15:], far[..., :5] = 0.02, 0.02
    plain = Drr(grid, camera)(x)
    assert torch.equal(AttenuatedTransform(grid, camera, far)(x), plain)
    assert AttenuatedTransform(grid, camera, near)(x).item() < 0.7 * plain.item()


def test_a_parallel_collimator_stands_at_the_end_of_its_rays():
    grid = Grid.centred(size=(8, 8, 8), spacing=10.0)
    camera = parallel(n_views=1, detector={"pixels": [1, 1], "pixel_mm": [1.0, 1.0]})
    x, mu = torch.zeros(2, 8, 8, 8, dtype=torch.float64)
    x[3:5, 3:5, 3:5] = 1
    towards = camera.origin[0] - camera.source[0]
    beyond = (voxel_centres(grid).to(torch.float64) @ towards) > 20 * towards.norm()
    mu[beyond] = 0.02
    plain = RayTransform(grid, camera)(x[None, None])
    weak = AttenuatedTransform(grid, camera, mu)(x[None, None])
    torch.testing.assert_close(weak, plain * math.exp(-0.02 * 20), rtol=1e-9, atol=0)


def axial(count):
    """Voxels along the x axis, a pinhole on its side of +x, and the voxels' x."""
    grid = Grid.centred(size=(count, 3, 3), spacing=(240.0 / count, 4.0, 4.0))
    camera = dcspect80(pixels=1, columns=[0], rows=[0])
    camera = camera.moved(_onto_x(camera), torch.zeros(3, dtype=torch.float64))
    return grid, camera, (torch.arange(count, dtype=torch.float64) + 0.5) * 240 / count - 120


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_the_central_ray_of_a_filled_ball_has_its_closed_form(method):
    grid, camera, x = axial(24)
    ball = (x.abs() < 100).double().expand(1, 1, 3, 3, 24).contiguous()
    y = AttenuatedTransform(grid, camera, MU * ball[0, 0], method=method)(ball)
    assert y.item() == pytest.approx(-math.expm1(-200 * MU) / MU, rel=1e-12)
    assert y.item() == pytest.approx(62.09, abs=5e-3)


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_smooth_attenuation_converges_in_second_order(method):
    errors = []
    for count in (12, 24, 48):
        grid, camera, x = axial(count)
        phase = math.pi * x / 120
        mu = 0.01 * (1 + phase.cos())
        depth = 0.01 * (120 - x - 120 / math.pi * phase.sin())
        emission = mu * torch.exp(-depth)  # its integral is (1 - exp(-2 A)) / 2, A all of the depth
        shape = (1, 1, 3, 3, count)
        A = AttenuatedTransform(grid, camera, mu.expand(shape[2:]).contiguous(), method=method)
        y = A(emission.expand(shape).contiguous()).item()
        errors.append(abs(y + math.expm1(-4.8) / 2))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)


def _onto_x(camera):
    """The rotation that takes the pinhole onto the x axis."""
    first = camera.source[0] / camera.source[0].norm()
    second = torch.linalg.cross(torch.tensor([0.0, 0, 1]).double(), first)
    second = second / second.norm()
    return torch.stack([first, second, torch.linalg.cross(first, second)])


@pytest.mark.parametrize("method", ["joseph", "siddon"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_kernels_agree_with_the_oracle_and_the_adjoint_is_matched(method, dtype, tolerance):
    grid, mu, x = scene(dtype)
    results = []
    for backend in ("cpu", "reference"):
        m, e = mu.clone().requires_grad_(), x.clone().requires_grad_()
        A = AttenuatedTransform(grid, rig(), m, method=method, backend=backend)
        y = A(e)
        z = torch.linspace(-1, 2, y.numel(), dtype=dtype).reshape(y.shape)
        back = A.adjoint(z)
        ends = [(y.double() * z).sum().item(), (e.double() * back).sum().item()]
        assert ends[0] == pytest.approx(ends[1], rel=tolerance)
        by_back = torch.autograd.grad((back * x).sum(), m, retain_graph=True)
        results.append([y, back, *torch.autograd.grad((y * z).sum(), (m, e)), *by_back])
        assert A.last_backend == backend
    for one, other in zip(*results, strict=True):
        assert (one - other).norm() <= tolerance * other.norm()


def test_gradients_agree_with_differences_in_pose_and_in_second_order():
    grid, mu, x = scene()
    camera = rig((2, 3))[[1]]
    m, e = mu.clone().requires_grad_(), x[:, :1].clone().requires_grad_()
    A = AttenuatedTransform(grid, camera, m)
    line = torch.autograd.grad((A(e) ** 2).sum(), m, create_graph=True)[0]
    assert torch.autograd.grad(line.sum(), e)[0].isfinite().all()

    def moved(source):
        some = type(camera)(source, camera.origin, camera.u, camera.v, (2, 3), extent="behind")
        return AttenuatedTransform(grid, some, mu)(x[:, :1])

    assert torch.autograd.gradcheck(moved, camera.source.clone().requires_grad_(), atol=1e-4)


def test_without_attenuation_it_is_the_plain_transform_to_the_last_bit():
    grid, mu, x = scene(torch.float32)
    A, plain = AttenuatedTransform(grid, rig(), 0 * mu), Drr(grid, rig())
    assert torch.equal(A(x), plain(x))
    assert torch.equal(A.adjoint(plain(x)), plain.adjoint(plain(x)))


def test_parts_are_those_of_the_whole():
    grid, mu, x = scene()
    A = AttenuatedTransform(grid, rig(), mu)
    y = A(x)
    torch.testing.assert_close(view_subset(A, [4, 1])(x), y[:, :, [4, 1]])
    chosen = torch.rand(y.shape[2:]) > 0.5
    torch.testing.assert_close(ray_subset(A, chosen)(x), y[:, :, chosen])
    support = torch.rand(grid.shape) > 0.5
    torch.testing.assert_close(A.with_support(support)(x), A(x * support))
    box = Box((1, 2, 3), (8, 9, 11))
    inside = torch.zeros_like(x)
    inside[:, :, *box.slices] = x[:, :, *box.slices]
    part = A.cropped(box, [5, 0])
    torch.testing.assert_close(part(x[:, :, *box.slices]), A(inside)[:, :, [5, 0]])


def test_every_bit_is_the_same_for_any_number_of_threads():
    grid, mu, x = scene(torch.float32)
    A = AttenuatedTransform(grid, rig((60, 60)), mu)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            y = A(x)
            results.append((y, A.adjoint(y)))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


def calls(A, x, y, count):
    """Views and volumes of so many calls, gradients too; from the second one on, the transmission
    along the rays may be kept.
    """
    results = []
    for _ in range(count):
        e = x.clone().requires_grad_()
        views = A(e)
        back = A.adjoint(y)
        results.append((views.detach(), back, torch.autograd.grad(views, e, y)[0]))
    return results


@pytest.fixture(scope="module")
def frozen():
    """What was imported and made before is no garbage, and `gc.collect` does not visit it."""
    gc.collect()
    gc.freeze()


def kept():
    """Bytes that are kept for operators that live."""
    gc.collect()
    return attenuated.kept_bytes()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_transmission_that_is_kept_changes_no_bit(method, dtype, frozen, monkeypatch):
    """Of views and volumes, for whole rigs and for parts of them."""
    grid, mu, x = scene(dtype)
    x[..., 9:] = 0
    every = AttenuatedTransform(grid, rig(), mu, method=method)
    chosen = torch.rand(every.range_shape) > 0.5
    before = kept()
    for A in (every, view_subset(every, [4, 1]), ray_subset(every, chosen)):
        y = torch.rand(1, 2, *A.range_shape, dtype=dtype)
        with monkeypatch.context() as patch:
            patch.setattr(attenuated, "MOST_KEPT", 0)
            (expected,) = calls(A, x, y, 1)
            assert kept() == before
        for of in calls(A, x, y, 2):
            assert all(torch.equal(*pair) for pair in zip(of, expected, strict=True))
        segments = {"joseph": 1, "siddon": 3}[method] * max(grid.shape)
        before += math.prod(A.range_shape) * segments * dtype.itemsize
        assert kept() == before
        assert torch.equal(torch.func.vmap(A)(x[None])[0], expected[0])


def test_transmission_is_kept_only_as_long_as_its_rays_and_values_live(frozen):
    grid, mu, x = scene(torch.float32)
    before, memory = kept(), mu.numpy().copy()
    own = torch.from_numpy(memory)
    A = AttenuatedTransform(grid, rig(), own)
    first, y = A(x), torch.ones(1, 2, *A.range_shape)
    back = A.adjoint(y)
    assert kept() > before
    own.mul_(0.5)
    half = AttenuatedTransform(grid, rig(), 0.5 * mu)
    for _ in range(3):
        assert torch.equal(A(x), half(x)) and torch.equal(A.adjoint(y), half.adjoint(y))
    memory[:] = mu.numpy()  # which torch does not see
    for _ in range(3):
        assert torch.equal(A(x), first) and torch.equal(A.adjoint(y), back)
    del A, half
    assert kept() == before


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_rays_beside_the_emission_and_what_lies_behind_it_change_no_bit(method):
    grid, mu, x = scene(torch.float32)
    x[:, 0] = 0
    x[0, 0, :2, 1:4, 7:] = 1  # in a corner; the other channel is full, and both are computed whole
    A = AttenuatedTransform(grid, rig(), mu, method=method)
    alone = A(x[:, :1])
    assert torch.equal(alone, A(x)[:, :1])
    assert 0 < (alone != 0).float().mean() < 0.9


@pytest.mark.parametrize("method", ["joseph", "siddon"])
def test_the_gradient_in_mu_is_the_same_where_rays_end_with_the_emission(method):
    """A second volume that emits everywhere, and whose views weigh nothing, forbids to skip."""
    grid, mu, x = scene()
    x[..., :6] = 0
    x[..., 9:] = 0
    everywhere = torch.stack([x[0, 0], torch.ones(grid.shape, dtype=x.dtype)])[None]
    mu.requires_grad_()
    A = AttenuatedTransform(grid, rig(), mu, method=method)
    weights = torch.rand(A(x[:, :1]).shape, dtype=x.dtype)
    none = torch.zeros_like(weights)
    skipped, whole = (
        torch.autograd.grad((A(volumes) * w).sum(), mu)[0]
        for volumes, w in ((x[:, :1], weights), (everywhere, torch.cat([weights, none], dim=1)))
    )
    assert A.last_backend == "cpu" and whole.any()
    torch.testing.assert_close(skipped, whole, rtol=1e-11, atol=1e-12 * whole.abs().max().item())
    assert not torch.autograd.grad(A(0 * x).sum(), mu)[0].any()


def test_skipping_of_empty_emission_is_switched_off_and_verified(monkeypatch):
    """A box that loses emission changes the views of "auto", raises with "verify", and leaves those
    of "off" alone, and their gradients.
    """
    grid, mu, x = scene()
    mu.requires_grad_()
    skips = "auto", "off", "verify"
    of = {skip: AttenuatedTransform(grid, rig(), mu, skip=skip) for skip in skips}
    exact = of["auto"](x)
    assert torch.equal(of["verify"](x), exact)
    (by_mu,) = torch.autograd.grad(exact.sum(), mu)
    lost = Box((0, 0, 0), (3, 3, 3))
    monkeypatch.setattr(cpu, "box_of", lambda values: lost)
    assert torch.equal(of["off"](x), exact) and not torch.equal(of["auto"](x), exact)
    assert torch.equal(torch.autograd.grad(of["off"](x).sum(), mu)[0], by_mu)
    with pytest.raises(RuntimeError, match="differ from those without skipping"):
        of["verify"](x)


def test_an_operator_reports_the_box_of_the_emission_that_it_skipped_beside():
    grid, mu, x = scene()
    x[..., :6] = 0
    x[..., 9:] = 0
    A = AttenuatedTransform(grid, rig(), mu)
    A(x)
    assert (A.skipped.mode, A.skipped.box) == ("box", box_of(x[0].numpy()))
    assert "beside or behind" in A.skipped.why
    dense = AttenuatedTransform(grid, rig(), mu, skip="off")
    dense(x)
    assert (dense.skipped.mode, dense.skipped.box) == ("off", Box.whole(grid.shape))


def test_no_emission_is_no_counts_and_nan_is_never_skipped():
    grid, mu, x = scene(torch.float32)
    A = AttenuatedTransform(grid, rig(), mu)
    assert not A(0 * x).any()
    one = torch.zeros_like(x[:, :1])
    one[0, 0, 0, 1, 11] = 1
    seen = A(one) != 0
    assert seen.any()
    assert A(one * torch.nan)[seen].isnan().all()


@pytest.mark.parametrize(
    ("value", "told"),
    [(0.15, "1/cm"), (-0.01, "zero or more"), (torch.nan, "finite")],
)
def test_impossible_attenuation_is_refused(value, told):
    """Attenuation that is negative, not finite or in 1/cm is refused, with the unit."""
    grid, mu, _ = scene()
    mu[3, 3, 3] = value
    with pytest.raises(ValueError, match=told):
        AttenuatedTransform(grid, rig(), mu)


def test_attenuation_of_another_grid_and_sampled_rays_are_refused():
    """Attenuation of another grid, or along rays of samples, is refused."""
    grid, mu, _ = scene()
    with pytest.raises(ValueError, match="sizes"):
        AttenuatedTransform(grid, rig(), mu[1:])
    with pytest.raises(ValueError, match="joseph"):
        AttenuatedTransform(grid, rig(), mu, method="trilinear")


def test_attenuation_that_is_filled_in_later_counts():
    grid, mu, x = scene()
    own = torch.zeros_like(mu)
    A = AttenuatedTransform(grid, rig(), own)
    assert torch.equal(A(x), Drr(grid, rig())(x))
    own.copy_(mu)
    assert torch.equal(A(x), AttenuatedTransform(grid, rig(), mu)(x))
    assert torch.equal(A.cropped(Box.whole(grid.shape), [1])(x), A(x)[:, :, [1]])
    A.mu.zero_()
    assert torch.equal(A(x), Drr(grid, rig())(x)) and A.mu_map() is None
