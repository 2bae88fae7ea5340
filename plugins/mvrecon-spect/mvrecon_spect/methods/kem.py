"""Kernel EM: reconstruction of an activity that is smooth where an anatomical volume is."""

import warnings
from pathlib import Path
from typing import Any, Unpack

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.quantities import NonNegativeInt, PositiveFloat, PositiveInt
from mvrecon.data.resample import resample
from mvrecon.data.volume_files import read_volume
from mvrecon.methods.classical.mlem import mlem
from mvrecon.methods.classical.solver import Common, declares
from mvrecon.operators.operator import Derived, LinearOperator
from mvrecon_spect.methods.priors import TIE

#: Difference in f of a voxel that is beyond the grid or the support.
ABSENT = 1e9


def kernel_matrix(
    anatomy: Float[Tensor, "d h w"],
    neighbours: int,
    reach: int,
    width: float,
    support: Bool[Tensor, "d h w"] | None = None,
) -> Float[Tensor, "n n"]:
    """The sparse matrix K_ij = exp(-|f_i - f_j|^2 / (2 width^2)) for the neighbours j of voxel i,
    in rows that sum to one; f is the anatomy over its standard deviation.

    Neighbours are the voxels with the most similar f in a window of `reach` voxels to each side,
    including i; of equally similar ones, up to rounding, the nearest, and all that are equally far.
    Rows and columns outside the support are zero.

    The Gaussian, the scale of f, the nearest neighbours and the row sums follow Wang and Qi, see
    `kem`. Their features are composite frames of a dynamic scan, with neighbours from the entire
    image. An anatomy is a single feature, constant within organs, so a search in the entire image
    would select arbitrarily among distant voxels. Their program also symmetrises K, which is not
    necessary here: unit row sums suffice to map a uniform alpha to a uniform x.

    Raises:
        ValueError: values that are not finite, or too many neighbours for the window.
    """
    side, f = 2 * reach + 1, anatomy.float()
    if not f.isfinite().all() or neighbours > side**3:
        raise ValueError(
            f"Expected a finite anatomy and at most {side**3} neighbours, got {neighbours}"
        )
    f = (f - f.mean()) / f.std().clamp_min(torch.finfo(f.dtype).tiny)
    f = f if support is None else torch.where(support, f, torch.inf)
    every = torch.arange(f.numel(), device=f.device).reshape(f.shape)
    padded = F.pad(f, [reach] * 6, value=torch.inf), F.pad(every, [reach] * 6)
    near, names = (p.unfold(0, side, 1).unfold(1, side, 1).unfold(2, side, 1) for p in padded)
    line = torch.arange(-reach, reach + 1, device=f.device).square().float()
    far = (line[:, None, None] + line[:, None] + line).flatten()
    places, weights = [], []
    # In slices, to save memory.
    for own, rows, values, numbers in zip(f, every, near, names, strict=True):
        apart = (values.reshape(own.numel(), -1) - own.reshape(-1, 1)).abs()
        apart = apart.nan_to_num(nan=ABSENT, posinf=ABSENT)
        limit = _last(apart, neighbours)
        rank = torch.where(apart < limit - TIE, -1.0, far)
        rank = rank.masked_fill(apart > limit + TIE, torch.inf)
        chosen = (rank <= _last(rank, neighbours)) & (apart < ABSENT)
        weight = torch.exp(apart.square() / (-2 * width**2)) * chosen
        weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-30)
        at = chosen.nonzero(as_tuple=True)
        columns = numbers.reshape(own.numel(), -1)[at]
        places.append(torch.stack([rows.flatten()[at[0]], columns]))
        weights.append(weight[at])
    size = f.numel(), f.numel()
    entries = torch.cat(places, dim=1), torch.cat(weights)
    return torch.sparse_coo_tensor(*entries, size, check_invariants=False).coalesce()


def _last(values: Float[Tensor, "n k"], count: int) -> Float[Tensor, "n 1"]:
    """The greatest of the least so many values of each row."""
    return values.topk(count, dim=1, largest=False).values.amax(dim=1, keepdim=True)


class Kernelled(Derived):
    """The operator A K for a sparse matrix K over voxels, and its transpose; subsets cost the same
    as those of A.
    """

    def __init__(self, A: LinearOperator, K: Float[Tensor, "n n"], turned: Float[Tensor, "n n"]):
        self.A, self.K, self.turned = A, K, turned
        self.domain_shape, self.range_shape = A.domain_shape, A.range_shape
        self.capabilities = A.capabilities & {"subset"}

    def volume(self, x: Tensor, transposed: bool = False) -> Float[Tensor, "b c d h w"]:
        """K x, or its transpose."""
        matrix = (self.turned if transposed else self.K).to(x.dtype)
        return (matrix @ x.reshape(-1, len(matrix)).mT).mT.reshape(x.shape)

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        return self.A(self.volume(x))

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        return self.volume(self.A.adjoint(y), transposed=True)

    def subset(self, selection: LinearOperator) -> LinearOperator:
        return Kernelled(self.A.subset(selection), self.K, self.turned)


def by_rows(K: Float[Tensor, "n n"]) -> Float[Tensor, "n n"]:
    """A sparse matrix in CSR format, whose product is ten times faster in torch."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support", UserWarning)
        return K.to_sparse_csr()


@declares(data_kind="counts", iterates=True, differentiable=False)
def kem(
    A: Any,
    counts: Float[Tensor, "b c m v u"],
    iterations: NonNegativeInt = 50,
    anatomy: Float[Tensor, "d h w"] | str | Path | None = None,
    neighbours: PositiveInt = 48,
    reach: PositiveInt = 3,
    width: PositiveFloat = 0.5,
    subsets: int = 1,
    background: float | Float[Tensor, "b c m v u"] = 0.0,
    **common: Unpack[Common],
) -> Float[Tensor, "b c d h w"]:
    """Kernel expectation maximisation for Poisson counts, in the unit of the volume: x = K alpha
    with alpha <- alpha / (K^T A^T 1) K^T A^T (y / (A K alpha + r)).

    This is MLEM for A K, so each iteration increases the likelihood (Wang and Qi, IEEE Trans. Med.
    Imaging 34 (2015) 61). Lesions that are not visible in the anatomy are smoothed.

    Args:
        A: the operator, in counts per unit of the volume.
        counts, iterations, subsets, background, common: see `mlem`; the initial volume is that of
            alpha.
        anatomy: volume on the grid, or the path of a volume such as a CT, which is resampled to the
            grid, with its least value beyond it; None: the operator's attenuation.
        neighbours, reach, width: parameters of K, see `kernel_matrix`; the examples of Wang's
            program have 48 neighbours and width 1.

    Raises:
        ValueError: no anatomy, or an anatomy of the wrong shape; see `mlem` and `kernel_matrix`.
    """
    f = A.mu_map() if anatomy is None else anatomy
    if isinstance(f, str | Path):
        values, source = read_volume(f)
        f = resample(values - values.min(), source, A.grid)  # zero, as of air, outside the file
    if f is None or f.shape != A.domain_shape:
        got = None if f is None else tuple(f.shape)
        raise ValueError(f"Expected an anatomy of {tuple(A.domain_shape)} voxels, got {got}")
    support, monitor = common.pop("support", None), common.pop("monitor", None)
    mask = None if support is None else support.to(A.device)
    K = kernel_matrix(f.detach().to(A.device), neighbours, reach, width, mask)
    B = Kernelled(A, by_rows(K), by_rows(K.t()))
    if monitor is not None:
        common["monitor"] = lambda at: monitor(at._replace(volume=B.volume(at.volume)))
    return B.volume(mlem(B, counts, iterations, background, subsets, **common))
