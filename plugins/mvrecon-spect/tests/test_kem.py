"""Kernel EM against its matrices, its likelihood, and the noise of OSEM at equal bias."""

import pytest
import torch

from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.methods.classical.mlem import osem
from mvrecon.testing import check_method
from mvrecon_spect.methods.kem import kem, kernel_matrix
from mvrecon_spect.operators.projector import Spect
from tests.methods.classical.methods import Dense, projector, truth


def random_anatomy(shape=(4, 5, 6)) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(5))


def test_an_iteration_matches_the_formula():
    A, f = Dense(), random_anatomy()
    y = A(truth(A))
    K = kernel_matrix(f, 10, 2, 0.7).double().to_dense()
    P, alpha = A.matrix, torch.full((120,), 0.3, dtype=torch.float64)
    for _ in range(3):
        ratio = y.flatten() / (P @ K @ alpha)
        alpha = alpha / (K.T @ P.T @ torch.ones_like(ratio)) * (K.T @ P.T @ ratio)
    start = torch.full((1, 1, 4, 5, 6), 0.3, dtype=torch.float64)
    x = kem(A, y, 3, f, neighbours=10, reach=2, width=0.7, start=start)
    torch.testing.assert_close(x.flatten(), K @ alpha)


def test_kernel_rows_contain_the_most_similar_voxels_of_the_window():
    f = random_anatomy()
    K = kernel_matrix(f, 10, 1, 0.7).to_dense()
    scaled, index = f / f.std(), 3 + 6 * (2 + 5 * 1)  # the voxel (1, 2, 3), not at the border
    apart = torch.full_like(f, torch.inf)
    apart[0:3, 1:4, 2:5] = (scaled[0:3, 1:4, 2:5] - scaled[1, 2, 3]).square()
    chosen = apart.flatten().argsort()[:10]
    row = torch.zeros(120)
    row[chosen] = torch.exp(-apart.flatten()[chosen] / (2 * 0.7**2))
    torch.testing.assert_close(K[index], row / row.sum())


def test_equal_features_are_smoothed():
    """A row is the mean of the nearest voxels: a constant stays, noise falls as their number."""
    K = kernel_matrix(torch.full((9, 10, 11), 0.015), 27, 3, 0.5)
    torch.testing.assert_close((K @ torch.ones(990, 1))[:, 0], torch.ones(990))
    noise = torch.randn(990, 2000, generator=torch.Generator().manual_seed(0))
    inner = (K @ noise).var(dim=1).reshape(9, 10, 11)[2:-2, 2:-2, 2:-2]
    torch.testing.assert_close(inner, torch.full_like(inner, 1 / 27), rtol=0.2, atol=0)


def test_rounding_and_mirrors_do_not_decide_between_equal_voxels():
    """The 48 nearest of equal voxels are 33 up to a distance, and a half of the next 24. Also
    tried: 10 and 100 neighbours.
    """
    f, rng = torch.zeros(12, 12, 12), torch.Generator().manual_seed(0)
    f[3:9, 3:9, 3:9], f[4:6, 4:6, 4:6] = 1.0, 2.0
    x = torch.rand(f.shape, generator=rng)

    def smoothed(f, x):
        return (kernel_matrix(f, 48, 3, 0.5) @ x.reshape(-1, 1)).view(f.shape)

    near = f * (1 + 1e-7 * torch.randn(f.shape, generator=rng))
    torch.testing.assert_close(smoothed(near, x), smoothed(f, x))
    for axis in range(3):
        mirrored = smoothed(f.flip(axis), x.flip(axis)).flip(axis)
        torch.testing.assert_close(mirrored, smoothed(f, x))


@pytest.mark.parametrize("background", [0.0, 2.0])
def test_each_iteration_raises_the_likelihood(background):
    A = Dense()
    rng, costs = torch.Generator().manual_seed(2), []
    y = torch.poisson(20 * A(truth(A)) + background, rng)
    options = {"anatomy": random_anatomy(), "background": background, "neighbours": 20}
    kem(A, y, 30, **options, monitor=lambda at: costs.append(at.objective) and None)
    fall = torch.stack(costs).diff(dim=0)
    assert len(costs) == 30 and (fall < 0).all()


def test_voxels_outside_the_support_are_zero_and_do_not_contribute():
    A, support = Dense(), torch.ones(4, 5, 6, dtype=torch.bool)
    support[2:] = False
    K = kernel_matrix(random_anatomy(), 10, 2, 0.7, support).to_dense()
    assert not K[60:].any() and not K[:, 60:].any()
    torch.testing.assert_close(K[:60].sum(dim=1), torch.ones(60))
    x = kem(A, A(truth(A) * support), 5, random_anatomy(), support=support)
    assert x[..., :2, :, :].min() > 0 and not x[..., 2:, :, :].any()


def test_a_lesion_of_the_anatomy_has_less_noise_than_osem_at_equal_bias():
    """Noise of the lesion's voxels over 12 seeds, where the bias of its mean is that of OSEM."""
    grid, rig = Grid.centred(12, spacing=10.0), dcspect80(pixels=24, columns=[2, 7, 12, 17])
    anatomy = torch.zeros(grid.shape)
    anatomy[2:10, 2:10, 2:10] = 0.015
    anatomy[5:8, 5:8, 5:8] = 0.03
    lesion = anatomy == 0.03
    x = 240.0 * (anatomy > 0) + 720.0 * lesion
    A, rng = Spect(grid, rig), torch.Generator().manual_seed(0)
    y = torch.poisson(A(x[None, None]).expand(12, -1, -1, -1, -1), rng)

    def figures(method, iterations, **options) -> list[tuple[float, float]]:
        found: list[tuple[float, float]] = []

        def see(at):
            values = at.volume[:, 0, lesion] / 960.0
            found.append((abs(values.mean().item() - 1), values.std(dim=0).mean().item()))

        method(A, y, iterations, monitor=see, **options)
        return found

    bias, noise = figures(osem, 12, subsets=4)[-1]
    found = figures(kem, 12, anatomy=anatomy)
    guided = next(spread for away, spread in found if away <= bias)
    assert bias < 0.1 and guided < noise / 3


def test_it_keeps_the_contract_of_methods():
    check_method("kem", projector(), iterations=4, anatomy=random_anatomy(projector().domain_shape))


def test_the_anatomy_defaults_to_attenuation_and_a_wrong_shape_is_refused():
    A = Dense()
    y = A(truth(A))
    with pytest.raises(ValueError, match="anatomy of .4, 5, 6. voxels, got None"):
        kem(A, y)
    with pytest.raises(ValueError, match=r"got \(5, 5, 6\)"):
        kem(A, y, anatomy=torch.ones(5, 5, 6))
    with pytest.raises(ValueError, match="finite anatomy and at most 27"):
        kem(A, y, anatomy=torch.ones(4, 5, 6), reach=1)
    grid, rig = Grid.centred(6, spacing=20.0), dcspect80(pixels=8, columns=[2, 12])
    mu = torch.zeros(grid.shape)
    mu[1:5, 1:5, 1:5] = 0.015
    B = Spect(grid, rig, mu=mu)
    y = B(torch.ones(1, 1, *grid.shape))
    assert torch.equal(kem(B, y, 2), kem(B, y, 2, anatomy=mu))


@pytest.mark.parametrize("air", [-1000.0, 0.0])
def test_beyond_a_short_ct_the_anatomy_is_air(tmp_path, air):
    """Not 0 HU, water, which smears the body: the volume is that by a CT of the whole grid. Also
    tried: a CT about a corner of the grid, turned against it.
    """
    grid, rig = Grid.centred(12, spacing=10.0), dcspect80(pixels=16, columns=[2, 7, 12, 17])
    A, place = Spect(grid, rig, 4.0), torch.tensor([10.0, 0.0, -5.0])
    y = A(2e3 * ((voxel_centres(grid) - place).norm(dim=-1) < 28).float()[None, None])
    volumes = []
    for size in (30, 40):  # 90 mm, and all 120 mm
        ct = Grid.centred(size, spacing=3.0)
        body = (voxel_centres(ct) - place).norm(dim=-1) < 28
        save_volume(tmp_path / "ct.nii.gz", torch.where(body, 40.0, air), ct)
        volumes.append(kem(A, y, 10, anatomy=tmp_path / "ct.nii.gz"))
    torch.testing.assert_close(*volumes, rtol=1e-3, atol=1.0)
