"""What the tests of the reconstructors share: operators, and what each method promises."""

import math
from functools import cache
from typing import Any, NamedTuple

import torch

from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.poisson import PoissonLikelihood
from mvrecon.operators.operator import LinearOperator
from mvrecon.testing import gap as gap

GRID = Grid.centred(size=(8, 7, 6), spacing=2.0)
RIG = circular(9, 60.0, 100.0, {"pixels": [9, 11], "pixel_mm": 2.5}, start_degrees=5.0)


class Matrix(LinearOperator):
    """A matrix [m n] as an operator, whose products cost what the numbers in it cost."""

    def __init__(self, matrix: torch.Tensor, domain: tuple[int, ...], views: tuple[int, ...]):
        self.matrix, self.domain_shape, self.range_shape = matrix, domain, views

    def forward(self, x):
        return (x.flatten(2) @ self.matrix.T.to(x)).unflatten(2, self.range_shape)

    def adjoint(self, y):
        return (y.flatten(2) @ self.matrix.to(y)).unflatten(2, self.domain_shape)


class Dense(Matrix):
    """A matrix without negative entries, which knows neither grid nor cameras."""

    def __init__(self) -> None:
        random = torch.Generator().manual_seed(3)
        matrix = torch.rand(210, 120, dtype=torch.float64, generator=random)
        matrix[torch.rand(210, 120, generator=random) < 0.8] = 0
        super().__init__(matrix, (4, 5, 6), (6, 5, 7))


def projector(grid: Grid = GRID, cameras: Cameras = RIG):
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)


@cache
def tabulated(grid: Grid = GRID, cameras: Cameras = RIG) -> Matrix:
    """The matrix of a projector with its grid: a small one takes a fortieth of the projector's
    time, in tests of many iterations.
    """
    A = projector(grid, cameras)
    columns = torch.eye(math.prod(A.domain_shape), dtype=torch.float64)
    matrix = A(columns.unflatten(1, (1, *A.domain_shape))).flatten(1).T.contiguous()
    table: Any = Matrix(matrix, A.domain_shape, A.range_shape)
    table.grid = grid
    return table


class Promise(NamedTuple):
    """What a method promises.

    Args:
        options: for a quick run on the small operators.
        linear: the volume is linear in the views, with these further options.
        rate: the residual of consistent views after the run, relative to the views.
        penalised: has a weight, in the unit of the volume.
    """

    options: dict[str, Any]
    linear: dict[str, Any] | None = None
    rate: float = 1e-2
    penalised: bool = False


PROMISES = {
    "sirt": Promise({"iterations": 100, "momentum": True}, {"nonnegative": False}),
    "robust_sirt": Promise({"iterations": 100}, rate=3e-2),
    "os_sart": Promise({"iterations": 100}, {"nonnegative": False}),
    "cgls": Promise({"iterations": 40}, {}, 1e-3),
    "tikhonov": Promise({"iterations": 40, "weight": 1e-4}, {"weight": 0.1}),
    "fista_tv": Promise({"iterations": 100, "weight": 1e-6}, penalised=True),
    "pdhg_tv": Promise({"iterations": 200, "weight": 1e-6}, penalised=True),
    "mlem": Promise({"iterations": 100}, rate=2e-2),
    "osem": Promise({"iterations": 30}, rate=2e-2),
}
#: Methods of certain rigs or of another grid, and one that does not iterate; tests of their own.
GEOMETRIC = {"fbp", "fdk", "finer", "backprojection"}
NAMES = [
    name
    for name in METHODS.names()
    if METHODS.origin(name).startswith("mvrecon.methods.classical.") and name not in GEOMETRIC
]


def counted(A, level: float = 20.0) -> torch.Tensor:
    views = A(truth(A))
    return torch.poisson(level / views.mean() * views, generator=torch.Generator().manual_seed(4))


def scale(A, counts) -> float:
    """The mean sensitivity of the voxels that are seen."""
    s = PoissonLikelihood(A, counts).sensitivity(torch.float64)
    return s[s > 0].mean().item()


def run(name: str, A, views, **options):
    """A registered method with the options of its promise."""
    return METHODS.build(name, A, views, **{**PROMISES[name].options, **options})


def truth(A, batch: int = 1, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Random volumes."""
    random = torch.Generator().manual_seed(1)
    return torch.rand(batch, 1, *A.domain_shape, dtype=dtype, generator=random)
