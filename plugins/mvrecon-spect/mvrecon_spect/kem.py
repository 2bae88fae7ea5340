"""Kernel EM: counts explained by an activity that is smooth where an anatomical volume is."""

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


def kernel_matrix(
    anatomy: Float[Tensor, "d h w"],
    neighbours: int,
    reach: int,
    width: float,
    support: Bool[Tensor, "d h w"] | None = None,
) -> Float[Tensor, "n n"]:
    """The sparse matrix K_ij = exp(-|f_i - f_j|^2 / (2 width^2)) for the neighbours j of voxel i,
    in rows that sum to one; f is the anatomy over its standard deviation.

    Neighbours are the voxels of the most similar f in a window of `reach` voxels to each side, i
    among them, of equal ones the nearest. Rows and columns outside the support are zero.

    The Gaussian, the scale of f, the nearest neighbours and the sums of rows are those of Wang and
    Qi, see `kem`. Their features are composite frames of a dynamic scan, and neighbours come from
    all of the image. An anatomy is one feature, equal in whole organs: in all of the image, the
    choice among distant voxels would be arbitrary. Their program also makes K symmetric, which is
    not done here: rows that sum to one suffice for a uniform alpha to be a uniform x.

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
    far = (line[:, None, None] + line[:, None] + line).flatten() * 1e-6  # decides between equals
    columns, weights = [], []
    for own, values, numbers in zip(f, near, names, strict=True):  # slices, for the memory
        apart = (values.reshape(own.numel(), -1) - own.reshape(-1, 1)).square()
        apart = torch.where(apart.isfinite(), apart, torch.inf)
        chosen = (apart + far).topk(neighbours, dim=1, largest=False).indices
        weight = torch.exp(apart.gather(1, chosen) / (-2 * width**2))
        weights.append(weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-30))
        columns.append(numbers.reshape(own.numel(), -1).gather(1, chosen))
    rows = every.flatten().repeat_interleave(neighbours)
    places, values = torch.stack([rows, torch.cat(columns).flatten()]), torch.cat(weights).flatten()
    size = f.numel(), f.numel()
    return torch.sparse_coo_tensor(places, values, size, check_invariants=False).coalesce()


class Kernelled(Derived):
    """The operator A K of a sparse matrix K of voxels and its transpose, whose subsets cost what
    those of A do.
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
    """A sparse matrix by rows (CSR), whose product torch computes ten times as fast."""
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
    """Kernel expectation maximisation of Poisson counts, in the unit of the volume: x = K alpha
    with alpha <- alpha / (K^T A^T 1) K^T A^T (y / (A K alpha + r)).

    It is MLEM of A K, so that each step raises the likelihood (Wang and Qi, IEEE Trans. Med.
    Imaging 34 (2015) 61). A lesion that the anatomy does not show is smoothed.

    Args:
        A: the operator, in counts per unit of the volume.
        counts, iterations, subsets, background, common: as for `mlem`; the start is that of alpha.
        anatomy: on the grid, or the path of a volume, which is resampled to it, such as a CT; None:
            the operator's attenuation.
        neighbours, reach, width: of K, see `kernel_matrix`; the examples of Wang's program have 48
            neighbours and the width 1.

    Raises:
        ValueError: no anatomy, or one of another shape; as `mlem` and `kernel_matrix`.
    """
    anatomy = A.mu_map() if anatomy is None else anatomy
    f = resample(*read_volume(anatomy), A.grid) if isinstance(anatomy, str | Path) else anatomy
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
