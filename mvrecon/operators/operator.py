"""Linear operators y = A x: adjoint, products, weights, and parts of an operator.

A subclass of `LinearOperator` implements the shapes, A x and A^T y. Its parts (`subset`, `cropped`,
`with_support`) default to computing the whole operator.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.symmetry import Mirror, same_weights
from mvrecon.geometry.grid import Box, Grid, placed, subdivided


@dataclass(frozen=True, eq=False)
class PixelIntegral:
    """A pixel as a weight times the mean integral along lines through it, in (unit of the volume) *
    mm times the weight's unit.

    Args:
        weight: weight of each pixel, broadcasts to [m v u]; one: the integral itself.
        rays: lines each way over a pixel, evenly spaced; 1: the line through its centre.
    """

    weight: Tensor = field(default_factory=lambda: torch.ones((), dtype=torch.float64))
    rays: int = 1


Weight = Tensor | Callable[[], Tensor] | None


class LinearOperator:
    """A linear map y = A x from tensors [b c *domain_shape] to [b c *range_shape], and its adjoint.

    `capabilities` names the parts that cost less than the whole operator, so that algorithms rely
    on savings only where they exist.

    Examples:
        >>> class Doubled(mv.LinearOperator):
        ...     domain_shape = range_shape = (3,)
        ...     def forward(self, x):
        ...         return 2 * x
        ...     adjoint = forward
        >>> (5 * Doubled()).T(torch.ones(1, 1, 3))
        tensor([[[10., 10., 10.]]])
    """

    domain_shape: tuple[int, ...]
    range_shape: tuple[int, ...]
    #: Parts that cost less than the whole: "subset", "crop", "support"; and "refine", for an
    #: operator that supports finer grids.
    capabilities: frozenset[str] = frozenset()

    def __init_subclass__(cls, **options: object) -> None:
        """A subclass with another `forward` does not inherit `pixel_integral`."""
        super().__init_subclass__(**options)
        if "forward" in vars(cls) and "pixel_integral" not in vars(cls):
            cls.pixel_integral = LinearOperator.pixel_integral

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        """y = A x."""
        raise NotImplementedError

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        """x = A^T y: the transpose of `forward`, <A x, y> = <x, A^T y>."""
        raise NotImplementedError

    def __call__(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return self.forward(x)

    @property
    def device(self) -> torch.device:
        """Device of the computation."""
        return torch.device("cpu")

    @property
    def pose_gradient(self) -> bool:
        """Whether the cameras' pose requires a gradient; nothing derived from it may be cached."""
        return False

    @property
    def T(self) -> "LinearOperator":
        """The adjoint as an operator; its own adjoint is this operator."""
        return Transposed(self)

    def __matmul__(self, other: Any) -> Any:
        """A @ B is the operator A B; A @ x is A x."""
        return Composed(self, other) if isinstance(other, LinearOperator) else self(other)

    def __rmul__(self, factor: float) -> "LinearOperator":
        """factor * A."""
        return Scaled(self, pixels=torch.tensor(float(factor), dtype=torch.float64))

    def subset(self, selection: "LinearOperator") -> "LinearOperator":
        """S A, the selected entries of A x; S is a selection of `operators/selection.py`.

        Raises:
            ValueError: no selection.
        """
        if not isinstance(selection, LinearOperator):
            raise ValueError(
                f"Expected a selection, as view_subset(A, [0, 2]) of mvrecon.operators.selection "
                f"makes it of indices, got {type(selection).__name__}"
            )
        return Composed(selection, self)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> "Projector":
        """A for volumes that are zero outside a box of the grid, and for some cameras."""
        return Cropped(self, box, views)

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> "LinearOperator":
        """A diag(support): voxels outside the mask are neither read nor written."""
        return self if support is None else Scaled(self, voxels=support)

    def refined(self, factor: int) -> Any:
        """A on a grid `factor` times finer, each pixel the mean over `factor` times as many rays
        each way; the views' shape stays.

        Raises:
            ValueError: the operator does not support finer grids.
        """
        raise ValueError(
            f"Expected an operator that supports a grid {factor} times finer, such as drr or "
            f"radon, got {type(self).__name__}"
        )

    def pixel_integral(self) -> PixelIntegral | None:
        """How a pixel consists of line integrals; None: not so, or not known."""
        return None

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """The mu-map that attenuates photons along a pixel's lines, in 1/mm on the grid; None:
        none, or not known.
        """
        return None

    def mirror(self) -> Mirror | None:
        """A plane of symmetry, A(F x) = G(A x); None if not known."""
        return None

    #: Whether pixels are expected counts of a volume that emits, in place of line integrals.
    emission = False
    #: Whether each sample of a batch has its own operator.
    per_sample = False

    def for_case(self, case: Mapping[str, Any]) -> Any:
        """The operator of a batch of cases: another one only of an operator with something of a
        case's own, such as the attenuation map of a patient.

        Args:
            case: a batch of the data set, by name.
        """
        return self

    def of_sample(self, index: int) -> Any:
        """The operator of one sample of a batch."""
        return self

    def of_samples(self, indices: Sequence[int]) -> Any:
        """The operator of some samples of a batch."""
        return self


def sees_integrals(A: LinearOperator) -> bool:
    """Whether an operator's pixels are plain line integrals."""
    pixel = A.pixel_integral()
    return pixel is not None and bool((pixel.weight == 1).all())


class Symmetric(LinearOperator):
    """An operator that is its own adjoint."""

    def __init__(self, shape: Sequence[int], device: torch.device | str):
        self.domain_shape = self.range_shape = tuple(shape)
        self._device = torch.device(device)

    @property
    def device(self) -> torch.device:
        return self._device

    def adjoint(self, y: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *n"]:
        return self.forward(y)


class Projector(nn.Module, LinearOperator):
    """A linear operator between a grid's volumes [b c d h w] and a rig's views [b c m v u]."""

    grid: Grid
    cameras: Cameras


class Derived(LinearOperator):
    """An operator derived from another, A: on its device, with its cameras' gradient."""

    A: Any

    @property
    def device(self) -> torch.device:
        return self.A.device

    @property
    def emission(self) -> bool:
        return self.A.emission

    @property
    def grid(self) -> Grid:
        return self.A.grid

    @property
    def pose_gradient(self) -> bool:
        return self.A.pose_gradient


class Transposed(Derived):
    """The adjoint of an operator as an operator."""

    def __init__(self, A: LinearOperator):
        self.A = A
        self.domain_shape, self.range_shape = A.range_shape, A.domain_shape

    @property
    def T(self) -> LinearOperator:
        return self.A

    def forward(self, x: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        return self.A.adjoint(x)

    def adjoint(self, y: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return self.A(y)


class Composed(nn.Module, Derived):
    """The product S A of two operators, x -> S (A x).

    Raises:
        ValueError: shapes that do not agree.
    """

    S: Any

    def __init__(self, S: LinearOperator, A: LinearOperator):
        super().__init__()
        if S.domain_shape != A.range_shape:
            shapes = f"{S.domain_shape} and {A.range_shape}"
            raise ValueError(
                f"Expected S's domain to be A's range for the product S A, got {shapes}"
            )
        self.S, self.A = S, A
        self.domain_shape, self.range_shape = A.domain_shape, S.range_shape

    @property
    def pose_gradient(self) -> bool:
        return self.S.pose_gradient or self.A.pose_gradient

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return self.S(self.A(x))

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        return self.A.adjoint(self.S.adjoint(y))

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """A's."""
        return self.A.mu_map()


class Wrapped(Derived, Projector):
    """A projector derived from another operator, with its shapes, device, grid and cameras."""

    def __init__(self, A: LinearOperator):
        super().__init__()
        self.A = A
        self.domain_shape, self.range_shape = A.domain_shape, A.range_shape

    @property
    def cameras(self) -> Cameras:
        return self.A.cameras


class Scaled(Wrapped):
    """An operator with a weight for each pixel and voxel, y = p * A (v * x).

    Subsets, crops and supports are those of A, weighted accordingly.

    Args:
        A: the operator.
        pixels: factors p that broadcast to [*range_shape], or a function that returns them, called
            at every use if the cameras require a gradient. None: one.
        voxels: factors v or a mask [*domain_shape]; a mask also zeroes non-finite values. None:
            one.
    """

    voxels: Tensor | None
    fixed_factors: Tensor | None

    def __init__(self, A: LinearOperator, pixels: Weight = None, voxels: Tensor | None = None):
        super().__init__(A)
        self.capabilities = A.capabilities
        self.factors = pixels if callable(pixels) else None
        fixed = pixels() if callable(pixels) else pixels
        self.register_buffer("fixed_factors", fixed, persistent=False)
        self.register_buffer("voxels", voxels, persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Scaled":
        exact = self.fixed_factors, self.voxels
        super()._apply(fn, recurse)  # moves them, without loss of precision
        self.fixed_factors, self.voxels = (None if w is None else w.to(self.device) for w in exact)
        return self

    @property
    def pixels(self) -> Tensor | None:
        """The pixels' factors."""
        if self.factors is None or not self.pose_gradient:
            return self.fixed_factors
        return self.factors()

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        y, factors = self.A(self._weighted(x)), self.pixels
        return y if factors is None else y * factors.to(y)

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        if (factors := self.pixels) is not None:
            # in the wider of the two precisions: half would round small factors to zero
            y = y * factors.to(y.device, torch.promote_types(y.dtype, torch.float32))
        return self._weighted(self.A.adjoint(y))

    def _weighted(self, x: Tensor) -> Tensor:
        if self.voxels is None:
            return x
        mask = self.voxels.dtype == torch.bool
        return torch.where(self.voxels, x, 0) if mask else x * self.voxels.to(x)

    def subset(self, selection: LinearOperator) -> LinearOperator:
        def chosen(factors: Tensor) -> Tensor:
            return selection(factors.expand(self.range_shape)[None, None])[0, 0]

        return Scaled(self.A.subset(selection), self._changed(chosen), self.voxels)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        keep = list(range(self.range_shape[0]) if views is None else views)
        pixels = self._changed(lambda factors: factors.expand(self.range_shape)[keep])
        voxels = None if self.voxels is None else self.voxels[box.slices]
        return Scaled(self.A.cropped(box, views), pixels, voxels)

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> LinearOperator:
        return Scaled(self.A.with_support(support), self.factors or self.fixed_factors, self.voxels)

    def refined(self, factor: int) -> Projector:
        voxels = None if self.voxels is None else subdivided(self.voxels, factor)
        return Scaled(self.A.refined(factor), self.factors or self.fixed_factors, voxels)

    def pixel_integral(self) -> PixelIntegral | None:
        """A's, times the pixels' factors."""
        own, factors = self.A.pixel_integral(), self.pixels
        if own is None or self.voxels is not None:
            return None
        return own if factors is None else replace(own, weight=own.weight * factors)

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """A's."""
        return self.A.mu_map()

    def mirror(self) -> Mirror | None:
        """A's, if it mirrors the weights into themselves, too."""
        mirror, p, v = self.A.mirror(), self.pixels, self.voxels
        if mirror is None:
            return None
        kept = p is None or same_weights(mirror.views(p.expand(self.range_shape)), p)
        return mirror if kept and (v is None or same_weights(mirror.volume(v), v)) else None

    def _changed(self, change: Callable[[Tensor], Tensor]) -> Weight:
        """The pixels' factors after a change, still a function if they were one."""
        if (factors := self.factors) is not None:
            return lambda: change(factors())
        return None if self.fixed_factors is None else change(self.fixed_factors)


class Cropped(Wrapped):
    """A for volumes that are zero outside a box, and for some cameras, computed by the whole
    operator.

    Args:
        A: the operator on the whole grid.
        box: the voxels of the crop.
        views: indices of the cameras; None: all.
    """

    def __init__(self, A: LinearOperator, box: Box, views: Sequence[int] | None = None):
        super().__init__(A)
        count, *pixels = A.range_shape
        self.box, self.views = box, [int(v) for v in (range(count) if views is None else views)]
        self.domain_shape, self.range_shape = box.shape, (len(self.views), *pixels)

    @property
    def grid(self) -> Grid:
        return self.A.grid.cropped(self.box)

    @property
    def cameras(self) -> Cameras:
        return self.A.cameras[torch.tensor(self.views)]

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return self.A(placed(x, self.box, self.A.domain_shape))[:, :, self.views]

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        index = torch.tensor(self.views, device=y.device)
        whole = y.new_zeros(*y.shape[:2], *self.A.range_shape).index_copy(2, index, y)
        return self.A.adjoint(whole)[..., *self.box.slices]


class PerSample(Wrapped):
    """A batch of operators of the same shapes, one for each sample.

    A single volume or view is passed to all of them.

    Args:
        operators: the operator of each sample.
    """

    per_sample = True

    def __init__(self, operators: Sequence[Any]):
        super().__init__(operators[0])
        self.operators = nn.ModuleList(operators)

    def of_sample(self, index: int) -> Any:
        return self.operators[index]

    def of_samples(self, indices: Sequence[int]) -> "PerSample":
        return PerSample([self.operators[index] for index in indices])

    def forward(self, x: Float[Tensor, "#b c *n"]) -> Float[Tensor, "b c *m"]:
        return self._each(x, lambda A, one: A(one))

    def adjoint(self, y: Float[Tensor, "#b c *m"]) -> Float[Tensor, "b c *n"]:
        return self._each(y, lambda A, one: A.T(one))

    def _each(self, values: Tensor, apply: Callable[[Any, Tensor], Tensor]) -> Tensor:
        samples = values.expand(len(self.operators), *values.shape[1:]).split(1)
        return torch.cat([apply(A, one) for A, one in zip(self.operators, samples, strict=True)])

    def mu_map(self) -> Float[Tensor, "b d h w"] | None:
        """The mu-maps of the samples, zero where one has none; None if none has one."""
        operators: Any = self.operators
        maps = [A.mu_map() for A in operators]
        some = next((mu for mu in maps if mu is not None), None)
        if some is None:
            return None
        return torch.stack([torch.zeros_like(some) if mu is None else mu for mu in maps])

    def pixel_integral(self) -> PixelIntegral | None:
        """That of the first sample, if all have one."""
        operators: Any = self.operators
        found = [A.pixel_integral() for A in operators]
        return None if any(one is None for one in found) else found[0]
