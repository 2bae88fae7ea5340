"""Several photopeaks, and gated frames, in one likelihood."""

import pytest
import torch

import mvrecon as mv
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.operators.selection import ViewSelection
from mvrecon.operators.stacked import Stacked
from mvrecon.report.metrics import nrmse
from mvrecon.testing import adjoint_gap
from mvrecon_spect.operators.projector import Spect

GRID, RIG = Grid.centred(12, spacing=10.0), dcspect80(pixels=16, columns=[2, 7, 12, 17])
#: Photons per decay, attenuation in 1/mm and intrinsic FWHM in mm: 113 and 208 keV of 177Lu.
PEAKS = ((0.062, 0.0163, 3.5), (0.104, 0.0136, 2.5))


@pytest.fixture(scope="module")
def peaks() -> list[mv.LinearOperator]:
    return [
        share * Spect(GRID, RIG, 4.0, mu=mu, blur=True, intrinsic_mm=width)
        for share, mu, width in PEAKS
    ]


@pytest.fixture(scope="module")
def activity() -> torch.Tensor:
    x = torch.zeros(1, 1, *GRID.shape)
    x[..., 3:9, 3:9, 3:9] = 2000.0
    x[..., 4:7, 5:8, 4:6] = 6000.0
    return x


def test_views_are_those_of_each_operator_and_the_adjoint_is_matched(peaks, activity):
    A = Stacked(peaks)
    assert A.range_shape == (32, 16, 16)
    assert torch.equal(A(activity), torch.cat([B(activity) for B in peaks], dim=2))
    assert adjoint_gap(A) < 1e-5
    for views in ([0, 3, 17, 31], [17], [20, 1]):
        B = A.subset(ViewSelection(A.range_shape, views))
        torch.testing.assert_close(B(activity), A(activity)[:, :, views])
        assert adjoint_gap(B) < 1e-5
    with pytest.raises(ValueError, match="one size of views"):
        Stacked([peaks[0], Spect(GRID, dcspect80(pixels=8, columns=[2]))])


def test_both_photopeaks_are_better_than_each(peaks, activity):
    """Fitted to noise, the volume of all counts has the least error, in the scale of decays."""
    A, noise = Stacked(peaks), torch.Generator().manual_seed(0)
    counts = torch.poisson(A(activity), generator=noise)
    both = mv.osem(A, counts, 20, subsets=4)
    errors = [nrmse(both, activity)]
    for B, part in zip(peaks, counts.split(16, dim=2), strict=True):
        errors.append(nrmse(mv.osem(B, part, 20, subsets=4), activity))
    assert errors[0] < min(errors[1:])
    assert both.sum() == pytest.approx(activity.sum().item(), rel=0.02)


def test_gated_frames_with_known_shifts_give_the_volume_at_rest(activity):
    """Frames moved by whole voxels are the views of moved cameras; ignoring the motion blurs."""
    shifts = torch.tensor([[0.0, 0, 0], [0, 0, 10.0], [0, 10.0, 20.0]]).double()
    still, frames = Spect(GRID, RIG, 4.0), []
    for shift in shifts:
        steps = [int(s / 10) for s in shift]
        frames.append(still(activity.roll(steps[::-1], dims=(-3, -2, -1))))
    one = torch.eye(3).double()
    A = Stacked([Spect(GRID, RIG.moved(one, -shift), 4.0) for shift in shifts])
    counts = torch.cat(frames, dim=2)
    torch.testing.assert_close(A(activity), counts, rtol=1e-3, atol=1e-3 * counts.max().item())
    moving = mv.osem(A, counts, 8, subsets=4)
    blurred = mv.osem(Stacked([still] * 3), counts, 8, subsets=4)
    assert nrmse(moving, activity) < 0.7 * nrmse(blurred, activity)
