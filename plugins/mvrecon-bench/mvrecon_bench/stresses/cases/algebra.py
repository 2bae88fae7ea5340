"""Algebra and calculus: adjoints, linearity, orders of convergence, derivatives, maps and compiled
graphs, motions.
"""

from collections.abc import Callable
from functools import lru_cache, partial

import torch
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.parts import PROJECTORS
from mvrecon.projectors.ray_transform import METHODS
from mvrecon.scenes.solids import Phantom, Solids
from mvrecon.scenes.voxelise import voxelise
from mvrecon_bench.stresses.case import PRECISE, Case, DoesNotApply
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, gap, greatest
from mvrecon_bench.stresses.truths import Blob, ends, ways

#: Sums of rounded terms; 1e-6 is of the plan.
LINEAR = {torch.float64: 1e-13, torch.float32: 1e-6}
DIGITS = {torch.float64: 1e-12, torch.float32: 2e-6}
DOUBLE = (torch.float64,)
#: Grids on which an order of convergence is measured, along each axis, in a box of 48 mm.
GRIDS = (16, 32, 64)
#: Few rays, in a pose where none lies on a kink.
FEW = {"pixels": [3, 2], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}
SMALL = Grid.centred((3, 4, 3), (1.0, 1.2, 0.9), (3.0, -2.0, 4.0))
#: Projectors of other libraries that take any rig, by the plugin mvrecon-peers: Joseph's, Siddon's,
#: and samples.
ORACLES = ("rtk", "diffdrr", "nanodrr")


def adjoint(subject: ProjectorSubject) -> float:
    """<A x, y> and <x, A^T y> in twenty random geometries, relative to the greater; all positive:
    nothing cancels.
    """
    subject.need("matched")
    rng, worst = torch.Generator().manual_seed(0), 0.0
    for seed in range(20):
        shape = torch.randint(2, 9, (3,), generator=rng).tolist()
        spacing = 10 ** (torch.rand(3, generator=rng) - 0.5)
        centre = 20 * torch.rand(3, generator=rng, dtype=torch.float64) - 10
        pixels = torch.randint(1, 8, (2,), generator=rng).tolist()
        pitch, offset = (0.5 + 3 * torch.rand(2, 2, generator=rng)).tolist()
        grid = _turned(Grid.centred(shape, spacing.tolist(), centre.tolist()), rng)
        rig = subject.rig(
            grid, {"pixels": pixels, "pixel_mm": pitch, "offset_mm": offset}, n_views=1 + seed % 3
        )
        R = random_rotation(rng)
        A = subject.projector(grid, rig.moved(R, grid.centre - R @ grid.centre))
        x = subject.random(1, 2, *grid.shape, seed=seed)
        y = subject.random(1, 2, len(rig), *rig.shape, seed=seed + 100)
        one, two = (A(x).double() * y).sum(), (x.double() * A.T(y)).sum()
        worst = greatest(
            [worst, float((one - two).abs() / torch.maximum(one.abs(), two.abs()).clamp(min=1e-30))]
        )
    return worst


def linear(subject: ProjectorSubject) -> float:
    """Sums, multiples by 3, -1e-3 and 1e6, and nothing: the views of the same, and of nothing
    exactly nothing.
    """
    A = subject.projector(GRID, subject.rig())
    x, y = subject.random(2, 1, *GRID.shape)[:, None]
    seen, other = A(x), A(y)
    worst = gap(A(x + y), seen.double() + other.double())
    for factor in (3.0, -1e-3, 1e6):
        worst = greatest([worst, gap(A(factor * x), factor * seen.double())])
    return worst + float((A(0 * x) != 0).sum()) + float((A.T(0 * seen) != 0).sum())


def moved(subject: ProjectorSubject) -> float:
    """Volume and cameras turned and moved together, five times: the same views."""
    rig, volume = subject.rig(), subject.random(1, 1, *GRID.shape)
    views, rng, worst = subject.projector(GRID, rig)(volume), torch.Generator().manual_seed(0), 0.0
    for _ in range(5):
        R, t = random_rotation(rng), 100 * torch.randn(3, generator=rng, dtype=torch.float64)
        affine = GRID.affine.clone()
        affine[:3] = R @ affine[:3]
        affine[:3, 3] += t
        worst = greatest(
            [
                worst,
                gap(subject.projector(Grid(GRID.shape, affine), rig.moved(R, t))(volume), views),
            ]
        )
    return worst


def smooth(subject: ProjectorSubject) -> float:
    """How far the order in the voxel size is below two for a blob; below 0.9 where voxels are
    cells.
    """
    blob = Blob(torch.tensor([1.3, -0.7, 0.4], dtype=torch.float64), 5.0)
    return (0.9 if subject.of_cells else 1.8) - _order(
        subject, blob.values, lambda rig: blob.integrals(*rig.rays())
    )


def sharp(subject: ProjectorSubject) -> float:
    """How far the order in the voxel size is below one for an ellipsoid, a cylinder and a box,
    supersampled.
    """
    solids = _solids()
    return 0.9 - _order(
        subject, _voxels, lambda rig: solids.integrals(*rig.rays(), ray_extent=rig.ray_extent)
    )


def oracles(subject: ProjectorSubject) -> float:
    """The least distance from what another library's projector sees of a blob that fades before the
    faces.

    To a plugin's projector mvrecon's own are others too.
    """
    subject.need_lines()
    grid = Grid.centred((49, 49, 49), 1.0, (3.0, -2.0, 4.0))
    rig = subject.rig(grid, {"pixels": [9, 11], "pixel_mm": [0.9, 0.8], "offset_mm": [0.04, -0.03]})
    volume = Blob(grid.centre + 0.4, 5.5).values(grid).to(subject.device, subject.dtype)[None, None]
    views, gaps = subject.projector(grid, rig)(volume), []
    others = [{"name": name} for name in set(ORACLES) & set(PROJECTORS.names()) - {subject.name}]
    if not subject.ours:
        others += [
            {"name": "radon" if rig.parallel else "drr", "method": method} for method in METHODS
        ]
    for other in others:
        try:
            B = PROJECTORS.from_config(other, grid=grid, cameras=rig)
            gaps.append(gap(views, B(volume.cpu())))
        except (ImportError, ValueError):  # not installed, or made for other rigs
            continue
    if not gaps:
        raise DoesNotApply(
            "no other library's projector is installed that takes this rig; see mvrecon-peers"
        )
    return min(gaps)


def differences(subject: ProjectorSubject) -> float:
    """Derivatives by the volume and by every vector of the cameras, against central differences
    along four ways.
    """
    views, vectors = subject.posed(SMALL, subject.rig(SMALL, FEW, n_views=2))
    inputs = [subject.random(1, 1, *SMALL.shape).requires_grad_(), *vectors]
    rng, worst = torch.Generator().manual_seed(0), 0.0
    weights = subject.random(1, 1, 2, 3, 2, seed=1)
    found = torch.autograd.grad((views(*inputs) * weights).sum(), inputs)
    for index, slope in enumerate(found):
        for _ in range(4):
            way = torch.randn(slope.shape, generator=rng, dtype=torch.float64).to(slope)
            ends = [
                [*inputs[:index], inputs[index] + step * way, *inputs[index + 1 :]]
                for step in (1e-5, -1e-5)
            ]
            more, less = ((views(*each) * weights).sum() for each in ends)
            error = ((more - less) / 2e-5 - (slope * way).sum()).abs() / (slope.norm() * way.norm())
            worst = greatest([worst, float(error)])
    return worst


def kinks(subject: ProjectorSubject) -> float:
    """Rays along axes, on faces and edges, through corners, past the volume: derivatives by the
    pose not finite.
    """
    grid = Grid.centred((4, 4, 4), 1.0)
    halves = torch.cartesian_prod(*[torch.arange(-2, 10).double() / 2] * 2)
    rays = [ends(grid, axis, halves) for axis in range(3)] + [(-9 * ways(), 10 * ways())]
    if subject.beam[1] == "segment":
        rays.append((0 * ways(), 1e-12 * ways()))
    start, end = (torch.cat(points) for points in zip(*rays, strict=True))
    views, vectors = subject.posed(grid, subject.rays(start, end))
    volume = subject.random(1, 1, 4, 4, 4).requires_grad_()
    slopes = torch.autograd.grad(views(volume, *vectors).sum(), [volume, *vectors])
    return float(sum((~slope.isfinite()).sum() for slope in slopes))


def twice(subject: ProjectorSubject) -> float:
    """Second derivatives: by views and volume the operator itself; by the pose right, or
    NotImplementedError.
    """
    rig = subject.rig(SMALL, FEW, n_views=2)
    A, x, y = (
        subject.projector(SMALL, rig),
        subject.random(1, 1, *SMALL.shape),
        subject.random(1, 1, 2, 3, 2),
    )
    for leaf in (x, y):
        leaf.requires_grad_()
    by_y, by_x = torch.autograd.grad((A(x) * y).sum(), (y, x), create_graph=True)
    w, z = subject.random(*y.shape, seed=1), subject.random(*x.shape, seed=2)
    mixed = torch.autograd.grad((by_y * w).sum(), x)[0], torch.autograd.grad((by_x * z).sum(), y)[0]
    return greatest([gap(mixed[0], A.T(w)), gap(mixed[1], A(z))])


def twice_by_pose(subject: ProjectorSubject) -> float:
    """A second derivative by the source, against differences of the first, unless
    NotImplementedError tells of none.
    """
    views, (source, *others) = subject.posed(SMALL, subject.rig(SMALL, FEW, n_views=2))
    volume, way = subject.random(1, 1, *SMALL.shape), torch.randn(source.shape, dtype=torch.float64)

    def slope(at: Tensor, graph: bool = False) -> Tensor:
        total = views(volume, at, *others).square().sum()
        return (torch.autograd.grad(total, at, create_graph=graph)[0] * way).sum()

    try:
        (found,) = torch.autograd.grad(slope(source, True), source)
    except NotImplementedError as error:
        if not str(error):
            raise
        return 0.0
    more, less = (slope((source + step * way).detach().requires_grad_()) for step in (1e-5, -1e-5))
    return float(((found * way).sum() - (more - less) / 2e-5).abs() / (found.norm() * way.norm()))


def mapped(subject: ProjectorSubject) -> float:
    """vmap over volumes and over views, and maps in maps: what a loop gives."""
    A = subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2))
    x, y = subject.random(3, 2, 1, 1, *SMALL.shape), subject.random(3, 2, 1, 1, 2, 3, 2)
    worst = 0.0
    for act, given in ((A, x), (A.T, y)):
        loop = torch.stack([torch.stack([act(one) for one in each]) for each in given])
        worst = greatest([worst, gap(torch.func.vmap(act)(given[:, 0]), loop[:, 0])])
        worst = greatest(
            [worst, gap(torch.func.vmap(act, in_dims=1)(given[0].transpose(0, 1)), loop[0])]
        )
        worst = greatest([worst, gap(torch.func.vmap(torch.func.vmap(act))(given), loop)])
    return worst


def jacobian(subject: ProjectorSubject, act: Callable[..., Tensor]) -> float:
    """The Jacobian, its rows or columns mapped over: the views of every voxel alone."""
    A, x = (
        subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2)),
        subject.random(1, 1, *SMALL.shape),
    )
    columns = torch.stack(
        [A(one) for one in torch.eye(x.numel()).to(x).reshape(-1, *x.shape)], dim=-1
    )
    try:
        return gap(act(A, x).flatten(-x.ndim), columns)
    except RuntimeError as error:
        if "functorch" not in str(error):
            raise
        raise DoesNotApply("torch.func finds no derivative of it; torch.autograd does") from error


def pushed(subject: ProjectorSubject) -> float:
    """Derivatives forwards, by volume and by views: the operator, or its adjoint, on the
    tangent.
    """
    A, worst = subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2)), 0.0
    for act, shape in ((A, (1, 1, *SMALL.shape)), (A.T, (1, 1, 2, 3, 2))):
        given, tangent = subject.random(*shape), subject.random(*shape, seed=1)
        worst = greatest([worst, gap(torch.func.jvp(act, (given,), (tangent,))[1], act(tangent))])
    return worst


def compiled(subject: ProjectorSubject) -> float:
    """Operator, adjoint and pointwise functions in one graph, then of another size: values and
    gradients the same.
    """
    A = subject.projector(SMALL, subject.rig(SMALL, FEW, n_views=2))
    x = subject.random(1, 1, *SMALL.shape).requires_grad_()

    def step(x: Tensor) -> Tensor:
        return A.T((A(x.sin()) - 1).tanh())

    torch.compiler.reset()
    whole, worst = torch.compile(step, fullgraph=True, backend="aot_eager"), 0.0
    for given in (x, torch.cat([x, 2 * x])):  # the second makes the sizes of the graph symbols
        seen, expected = whole(given), step(given)
        slopes = [torch.autograd.grad(each.square().sum(), given)[0] for each in (seen, expected)]
        worst = greatest([worst, gap(seen, expected), gap(*slopes)])
    return worst


def _order(
    subject: ProjectorSubject, volume: Callable[[Grid], Tensor], truth: Callable[[Cameras], Tensor]
) -> float:
    """The slope of the error over three grids, finest to coarsest."""
    subject.need_lines()
    rig = subject.rig(
        _box(GRIDS[0]),
        {"pixels": [20, 21], "pixel_mm": [0.31, 0.33], "offset_mm": [0.03, 0.05]},
        n_views=4,
    )
    rig = rig.moved(
        random_rotation(torch.Generator().manual_seed(0)), torch.zeros(3)
    )  # or rows would follow slices
    errors = []
    for n in GRIDS:
        x = volume(_box(n)).to(subject.device, subject.dtype)[None, None]
        errors.append(gap(subject.projector(_box(n), rig)(x)[0, 0], truth(rig)))
    return float(torch.tensor(errors[0] / errors[-1]).log2()) / (len(errors) - 1)


def _box(n: int) -> Grid:
    """Voxels that are 48 / n mm wide, and a third longer along z."""
    return Grid.centred((n, n, n), (48 / n, 48 / n, 64 / n))


def _solids() -> Phantom:
    rng = torch.Generator().manual_seed(5)
    places = torch.tensor(
        [[1.0, -2.0, 4.5], [-9.0, 6.0, -12.0], [8.0, 5.0, -10.0]], dtype=torch.float64
    )
    axes = torch.tensor([[13.0, 16.0, 11.0], [6.0, 7.0, 9.0], [7.0, 5.0, 8.0]], dtype=torch.float64)
    kinds = zip(("ellipsoid", "cylinder", "box"), places, axes, strict=True)
    one = torch.ones(1)
    return Phantom(
        tuple(Solids(kind, p[None], random_rotation(rng, 1), a[None], one) for kind, p, a in kinds)
    )


@lru_cache(maxsize=8)
def _voxels_of(n: int) -> Tensor:
    return voxelise(_solids(), _box(n))


def _voxels(grid: Grid) -> Tensor:
    return _voxels_of(grid.shape[0])


def _turned(grid: Grid, rng: torch.Generator) -> Grid:
    """The same voxels about the same centre, in any direction."""
    R, affine = random_rotation(rng), grid.affine.clone()
    affine[:3, :3] = R @ affine[:3, :3]
    affine[:3, 3] = grid.centre - affine[:3, :3] @ grid.centre_index
    return Grid(grid.shape, affine)


def _jacrev(A: Callable[..., Tensor], x: Tensor) -> Tensor:
    return torch.func.jacrev(A)(x)  # type: ignore[return-value]


def _rows(A: Callable[..., Tensor], x: Tensor) -> Tensor:
    return torch.autograd.functional.jacobian(A, x, vectorize=True)  # type: ignore[return-value]


CASES = (
    Case(13, "all turned and moved together", "the same views", "projector", moved, DIGITS),
    Case(
        29,
        "the adjoint in twenty geometries",
        "<A x, y> = <x, A^T y>",
        "projector",
        adjoint,
        PRECISE,
    ),
    Case(30, "sums, multiples and nothing", "the views of the same", "projector", linear, LINEAR),
    Case(31, "a smooth blob on three grids", "what the order lacks", "projector", smooth),
    Case(31, "solids with edges on three grids", "what the order lacks", "projector", sharp),
    Case(
        32,
        "a blob seen by other libraries",
        "one of them sees the same",
        "projector",
        oracles,
        1e-3,
    ),
    Case(
        33, "derivatives by volume and pose", "differences", "projector", differences, 1e-6, DOUBLE
    ),
    Case(34, "derivatives where rays tie", "finite", "projector", kinks),
    Case(
        35,
        "second derivatives by volume and views",
        "the operator itself",
        "projector",
        twice,
        DIGITS,
    ),
    Case(
        35,
        "second derivatives by pose",
        "differences, or refused",
        "projector",
        twice_by_pose,
        1e-5,
        DOUBLE,
    ),
    Case(36, "vmap", "what a loop gives", "projector", mapped, LINEAR),
    Case(36, "jacrev", "the views of voxels", "projector", partial(jacobian, act=_jacrev), LINEAR),
    Case(
        36,
        "a Jacobian by rows at once",
        "the views of voxels",
        "projector",
        partial(jacobian, act=_rows),
        LINEAR,
    ),
    Case(36, "derivatives forwards", "the operator on the tangent", "projector", pushed, LINEAR),
    Case(
        37,
        "a compiled graph, of two sizes",
        "the eager one",
        "projector",
        compiled,
        DIGITS,
        (torch.float32,),
    ),
)
