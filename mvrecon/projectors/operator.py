"""Linear operators y = A x: the adjoint, weights, stacks, and the parts of an operator that a
caller asks for.
"""

from collections.abc import Callable, Sequence
from typing import Any, overload

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.symmetry import Mirror
from mvrecon.geometry.box import Box, placed
from mvrecon.geometry.grid import Grid

Weight = Tensor | Callable[[], Tensor] | None


class LinearOperator:
    """A linear map y = A x from tensors [b c *domain_shape] to tensors [b c *range_shape], with its
    adjoint.

    A subclass gives `domain_shape`, `range_shape`, `forward` and `adjoint`; that is all that SIRT,
    MLEM, likelihoods and models need. The parts of an operator (`subset`, `cropped`,
    `with_support`) always work: by default the whole operator is computed. An operator that can do
    a part at the part's cost overrides the method, and names it in `capabilities`, which is what an
    algorithm asks before it relies on the saving.
    """

    domain_shape: tuple[int, ...]
    range_shape: tuple[int, ...]
    #: The parts that cost less than the whole: "subset", "crop", "support".
    capabilities: frozenset[str] = frozenset()

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
        """Where the operator computes."""
        return torch.device("cpu")

    @property
    def pose_gradient(self) -> bool:
        """Whether a gradient by the cameras' pose is asked for: nothing that depends on it may then
        be kept.
        """
        return False

    @property
    def T(self) -> "LinearOperator":
        """The adjoint as an operator; its own adjoint is this operator."""
        return Transposed(self)

    @overload
    def __matmul__(self, other: "LinearOperator") -> "LinearOperator": ...
    @overload
    def __matmul__(self, other: Tensor) -> Tensor: ...
    def __matmul__(self, other: Any) -> Any:
        """A @ B is the operator A B; A @ x is A x."""
        return Composed(self, other) if isinstance(other, LinearOperator) else self(other)

    def __rmul__(self, factor: float) -> "LinearOperator":
        """factor * A."""
        return Scaled(self, pixels=torch.tensor(float(factor), dtype=torch.float64))

    def subset(self, selection: "LinearOperator") -> "LinearOperator":
        """The chosen entries of A x alone, S A; `selection` is S, from
        `projectors/selection.py`.
        """
        return Composed(selection, self)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> "LinearOperator":
        """A for volumes that are zero outside a box of the grid, and for some of the cameras (None:
        all).
        """
        return Cropped(self, box, views)

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> "LinearOperator":
        """A diag(support): what lies outside the mask is neither read nor written."""
        return self if support is None else Scaled(self, voxels=support)

    def mirror(self) -> Mirror | None:
        """A plane of symmetry, A(F x) = G(A x); None where none is known."""
        return None


class Projector(LinearOperator):
    """A linear operator between the volumes [b c d h w] of a grid and the views [b c m v u] of a
    rig.
    """

    grid: Grid
    cameras: Cameras


class Transposed(LinearOperator):
    """The adjoint of an operator as an operator."""

    def __init__(self, A: LinearOperator):
        self.A = A
        self.domain_shape, self.range_shape = A.range_shape, A.domain_shape
        self.forward, self.adjoint = A.adjoint, A.__call__

    @property
    def device(self) -> torch.device:
        return self.A.device

    @property
    def T(self) -> LinearOperator:
        return self.A


class Composed(nn.Module, LinearOperator):
    """The product A B of two operators, x -> A (B x).

    Raises:
        ValueError: shapes that do not agree.
    """

    def __init__(self, A: LinearOperator, B: LinearOperator):
        super().__init__()
        if A.domain_shape != B.range_shape:
            raise ValueError(
                f"A B needs A's domain to be B's range, got {A.domain_shape} and {B.range_shape}"
            )
        self.A, self.B = A, B
        self.domain_shape, self.range_shape = B.domain_shape, A.range_shape

    @property
    def device(self) -> torch.device:
        return self.B.device

    @property
    def pose_gradient(self) -> bool:
        return self.A.pose_gradient or self.B.pose_gradient

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return self.A(self.B(x))

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        return self.B.adjoint(self.A.adjoint(y))


class Wrapped(nn.Module, Projector):
    """What an operator made of another one takes over from it: shapes, device, grid and cameras."""

    def __init__(self, A: LinearOperator):
        super().__init__()
        self.A, self.capabilities = A, A.capabilities
        self.domain_shape, self.range_shape = A.domain_shape, A.range_shape

    @property
    def device(self) -> torch.device:
        return self.A.device

    @property
    def pose_gradient(self) -> bool:
        return self.A.pose_gradient

    @property
    def grid(self) -> Any:
        """Where the voxels lie."""
        return self.A.grid

    @property
    def cameras(self) -> Any:
        """The rig."""
        return self.A.cameras


class Scaled(Wrapped):
    """An operator with a weight for each pixel and voxel, y = p * A (v * x).

    Subsets, crops and supports are those of A, with the weights that belong to them.

    Args:
        A: the operator.
        pixels: factors that broadcast to [*range_shape], or a function that gives them, called at
            every use where the cameras want a gradient. None: one.
        voxels: factors or a mask [*domain_shape]; a mask leaves out what is not finite, too. None:
            one.
    """

    voxels: Tensor | None

    def __init__(self, A: LinearOperator, pixels: Weight = None, voxels: Tensor | None = None):
        super().__init__(A)
        self.factors = pixels if callable(pixels) else None
        self.register_buffer("kept", pixels() if callable(pixels) else pixels, persistent=False)
        self.register_buffer("voxels", voxels, persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Scaled":
        exact = self.kept, self.voxels
        super()._apply(fn, recurse)  # moves them; their digits stay
        self.kept, self.voxels = (None if w is None else w.to(self.device) for w in exact)
        return self

    @property
    def pixels(self) -> Tensor | None:
        """The pixels' factors."""
        return self.factors() if self.factors and self.pose_gradient else self.kept

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        y, factors = self.A(self._weighted(x)), self.pixels
        return y if factors is None else y * factors.to(y)

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        factors = self.pixels
        # in the wider of the two precisions: a half would round small factors to zero
        y = (
            y
            if factors is None
            else y * factors.to(y.device, torch.promote_types(y.dtype, torch.float32))
        )
        return self._weighted(self.A.adjoint(y))

    def _weighted(self, x: Tensor) -> Tensor:
        if self.voxels is None:
            return x
        return (
            torch.where(self.voxels, x, 0)
            if self.voxels.dtype == torch.bool
            else x * self.voxels.to(x)
        )

    def subset(self, selection: LinearOperator) -> LinearOperator:
        return Scaled(self.A.subset(selection), self._chosen(selection), self.voxels)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> LinearOperator:
        voxels = None if self.voxels is None else self.voxels[box.slices]
        pick = (lambda w: w) if views is None else (lambda w: self._whole(w)[list(views)])
        return Scaled(self.A.cropped(box, views), self._through(pick), voxels)

    def with_support(self, support: Bool[Tensor, "d h w"] | None) -> LinearOperator:
        return Scaled(self.A.with_support(support), self.factors or self.kept, self.voxels)

    def mirror(self) -> Mirror | None:
        """A's own, where it mirrors the weights into themselves, too."""
        mirror, factors = self.A.mirror(), self.pixels
        if (
            mirror is None
            or factors is not None
            and not _same(mirror.views(self._whole(factors)), factors)
        ):
            return None
        return (
            mirror
            if self.voxels is None or _same(mirror.volume(self.voxels), self.voxels)
            else None
        )

    def _chosen(self, selection: LinearOperator) -> Weight:
        return self._through(lambda w: selection(self._whole(w)[None, None])[0, 0])

    def _through(self, change: Callable[[Tensor], Tensor]) -> Weight:
        factors = self.factors
        if factors is not None:
            return lambda: change(factors())
        return None if self.kept is None else change(self.kept)

    def _whole(self, factors: Tensor) -> Tensor:
        return factors.expand(self.range_shape)


class Cropped(Wrapped):
    """A for volumes that are zero outside a box, and for some cameras, by way of the whole
    operator.

    Args:
        A: of the whole grid.
        box: the voxels of the crop.
        views: indices of the cameras; None: all.
    """

    def __init__(self, A: LinearOperator, box: Box, views: Sequence[int] | None = None):
        super().__init__(A)
        self.capabilities = frozenset()
        count, *pixels = A.range_shape
        self.box, self.views = box, list(range(count)) if views is None else [int(v) for v in views]
        self.domain_shape, self.range_shape = box.shape, (len(self.views), *pixels)

    @property
    def grid(self) -> Any:
        return self.A.grid.cropped(self.box)

    @property
    def cameras(self) -> Any:
        return self.A.cameras[torch.tensor(self.views)]

    def forward(self, x: Float[Tensor, "b c *n"]) -> Float[Tensor, "b c *m"]:
        return self.A(placed(x, self.box, self.A.domain_shape))[:, :, self.views]

    def adjoint(self, y: Float[Tensor, "b c *m"]) -> Float[Tensor, "b c *n"]:
        index = torch.tensor(self.views, device=y.device)
        whole = y.new_zeros(*y.shape[:2], *self.A.range_shape).index_copy(2, index, y)
        return self.A.adjoint(whole)[..., *self.box.slices]


def _same(one: Tensor, other: Tensor) -> bool:
    if one.dtype == torch.bool:
        return torch.equal(one, other)
    return torch.allclose(one, other.expand_as(one), rtol=1e-9, atol=0)
