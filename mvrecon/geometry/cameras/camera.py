"""The canonical record of a rig of M cameras, from which other descriptions (K, R, t, 3x4, frustum)
are derived.

Pixel (u, v) of camera m and the fraction w of the way from the source to the detector give the
point

    central beam    X = S + w (u U + v V + D0 - S)
    parallel beam   X = S + u U + v V + w (D0 - S)

so with the frame M = [U V D0-S] and q = M^-1 (X - S): w = q_3 and (u, v) = (q_1, q_2) / w for a
central beam, (q_1, q_2) for a parallel one. That is P = M^-1 [I -S] of Hartley & Zisserman,
Multiple View Geometry, ch. 6.

Convention: right-handed, as OpenCV: u to the right, v downwards, looking towards the object. A
pinhole's detector is behind it, so object points have w < 0 and the image is rotated by 180
degrees, without further code.
"""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.grid import Grid, pixel_centres
from mvrecon.geometry.rigid import check_rotation, unit

Extent = Literal["segment", "behind", "ahead", "line"]

#: The valid range of a ray's fraction w. X-ray, and a bounded parallel beam: "segment". A pinhole
#: with its detector behind it: "behind". A vision camera: "ahead". An unbounded parallel beam:
#: "line".
EXTENTS: dict[str, tuple[float, float]] = {
    "segment": (0.0, 1.0),
    "behind": (-torch.inf, 0.0),
    "ahead": (0.0, torch.inf),
    "line": (-torch.inf, torch.inf),
}

VECTORS = ("source", "origin", "u", "v")


@dataclass(frozen=True, eq=False)
class Cameras:
    """M cameras with detectors of one size.

    The vectors are copied, except tensors that require a gradient.

    Args:
        source: source or pinhole S in world mm; for a parallel beam, the start of the ray of pixel
            (0, 0).
        origin: centre D0 of pixel (0, 0) in world mm.
        u: step between columns, in mm.
        v: step between rows, in mm.
        shape: detector pixels (rows, columns).
        parallel: rays share the direction D0 - S instead of the point S.
        extent: the valid range of a ray's line; see `EXTENTS`.

    Raises:
        ValueError: inconsistent shapes, non-finite values, a flat or left-handed camera.

    Examples:
        >>> source = torch.tensor([[200.0, 0.0, 0.0]])  # an X-ray source on the x axis, in mm
        >>> corner = torch.tensor([[-100.0, -15.5, 15.5]])  # its detector's pixel (0, 0)
        >>> u, v = torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> rig = mv.Cameras(source, corner, u, v, shape=(32, 32))
        >>> rig.project(torch.zeros(1, 3))  # column, row and depth of the world's origin
        tensor([[[ 15.5000,  15.5000, 200.0000]]])
    """

    source: Float[Tensor, "m 3"]
    origin: Float[Tensor, "m 3"]
    u: Float[Tensor, "m 3"]
    v: Float[Tensor, "m 3"]
    shape: tuple[int, int]
    parallel: bool = False
    extent: Extent = "segment"

    def __post_init__(self) -> None:
        for name in VECTORS:
            vector = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            # a copy, except of parameters to optimise
            vector = vector if vector.requires_grad else vector.clone()
            object.__setattr__(self, name, vector)
            expected = (len(self.source) if self.source.ndim == 2 else "m", 3)
            if vector.ndim != 2 or vector.shape != expected or not len(vector):
                raise ValueError(
                    f"Cameras need {name} as [{expected[0]} 3], one row per camera, got "
                    f"{list(vector.shape)}"
                )
            if vector.device != self.source.device:
                raise ValueError(
                    f"Cameras need one device, got {name} on {vector.device}, source on "
                    f"{self.source.device}"
                )
            if not vector.isfinite().all():
                raise ValueError(f"Cameras need finite mm, got {name} = {vector.tolist()}")
        if len(self.shape) != 2 or any(int(n) != n or n < 1 for n in self.shape):
            raise ValueError(
                f"A detector's shape must be (rows, columns), both positive integers, got "
                f"{self.shape}"
            )
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        if self.extent not in EXTENTS:
            raise ValueError(f"Unknown extent {self.extent!r}. Known: {', '.join(EXTENTS)}")
        axes = unit(self.frame.detach(), dim=-2)
        det = torch.linalg.det(axes) * (-1 if self.extent == "behind" else 1)
        if not (det.abs() > 1e-9).all():
            flat = int(det.abs().argmin())
            raise ValueError(
                f"Cameras must not be flat, but u, v and origin - source of camera {flat} lie in "
                f"one plane: the "
                f"determinant of their directions is {det[flat]:.2g}, expected more than 1e-9"
            )
        if not (det > 0).all():
            raise ValueError(
                "Cameras must be right-handed (u right, v down, looking at the object), but camera "
                f"{int(det.argmin())} is left-handed; reverse u or v, and take origin at the "
                f"other end of that axis"
            )

    def __len__(self) -> int:
        return self.source.shape[0]

    def __getitem__(self, index: int | slice | list[int] | Tensor) -> "Cameras":
        """A rig of the selected cameras, in the given order.

        Raises:
            IndexError: an index of anything but cameras.
        """
        chosen = torch.arange(len(self), device=self.source.device)[index].reshape(-1)
        return self._map(lambda vector: vector[chosen])

    def __iter__(self) -> Iterator["Cameras"]:
        """Iterate over rigs of one camera each."""
        return (self[m] for m in range(len(self)))

    def _map(self, change: Callable[[Tensor], Tensor]) -> "Cameras":
        """Select or move cameras; not checked again, which would synchronise with a GPU."""
        vectors = {name: change(getattr(self, name)) for name in VECTORS}
        if not len(vectors["source"]):
            return replace(self, **vectors)  # raises
        other = copy(self)
        vars(other).update(vectors)
        return other

    def to(self, device: torch.device | str) -> "Cameras":
        """Move the rig to a device; geometry stays in float64."""
        return self._map(lambda vector: vector.to(device))

    @property
    def ray_extent(self) -> tuple[float, float]:
        """The valid range of a ray's fractions w."""
        return EXTENTS[self.extent]

    @property
    def frame(self) -> Float[Tensor, "m 3 3"]:
        """M = [U V D0-S], columns in mm."""
        return torch.stack([self.u, self.v, self.origin - self.source], dim=-1)

    @property
    def detector_centre(self) -> Float[Tensor, "m 3"]:
        """The centre of each detector, in mm."""
        rows, columns = self.shape
        return self.origin + self.u * (columns - 1) / 2 + self.v * (rows - 1) / 2

    @property
    def distance(self) -> Float[Tensor, " m"]:
        """Distance from the source to the detector's plane in mm (SDD; the collimator length of a
        pinhole).
        """
        normal = unit(torch.linalg.cross(self.u, self.v))
        return (normal * (self.origin - self.source)).sum(-1).abs()

    @property
    def matrix(self) -> Float[Tensor, "m 3 4"]:
        """P with P (X, 1) = w (u, v, 1); its last row is (0, 0, 0, 1) for a parallel beam."""
        inverse = torch.linalg.inv(self.frame)
        P = torch.cat([inverse, -inverse @ self.source[..., None]], dim=-1)
        if self.parallel:
            P = torch.cat([P[:, :2], P.new_tensor([0, 0, 0, 1]).expand(len(self), 1, 4)], dim=1)
        return P

    def project(self, xyz: Float[Tensor, "*n 3"]) -> Float[Tensor, "m *n 3"]:
        """Project world points to pixel coordinates and depth (u, v, z), z in mm along the
        detector's normal.

        z has the sign of w: negative on the far side of a pinhole from its detector. Points in the
        plane of a central source have no image: u and v are NaN; for non-finite points all three
        are. See `valid`; gradients of valid images are finite whatever the other points.

        Raises:
            ValueError: points of another shape.
        """
        if not xyz.ndim or xyz.shape[-1] != 3:
            raise ValueError(f"Points must be [.. 3], (x, y, z) in mm, got {list(xyz.shape)}")
        points, known = _known(xyz.reshape(1, -1, 3).to(self.source))
        flat = (points - self.source[:, None]) @ torch.linalg.inv(self.frame).mT
        uv, w = flat[..., :2], flat[..., 2:]
        if not self.parallel:
            uv = torch.where(w == 0, torch.nan, uv / torch.where(w == 0, 1.0, w))
        uvz = torch.where(
            known, torch.cat([uv, w * self.distance[:, None, None]], dim=-1), torch.nan
        )
        return uvz.reshape(len(self), *xyz.shape[:-1], 3).to(xyz.dtype)

    def valid(self, uvz: Float[Tensor, "m *n 3"]) -> Bool[Tensor, "m *n"]:
        """Whether images from `project` exist: finite, and within the valid range of a ray
        (`extent`).

        They may lie outside the detector.

        Raises:
            ValueError: images of another shape.
        """
        self._check_images(uvz)
        least, most = self.ray_extent
        w = uvz[..., 2] / self.distance.to(uvz).reshape(-1, *[1] * (uvz.ndim - 2))
        return uvz.isfinite().all(dim=-1) & (least <= w) & (w <= most)

    def unproject(self, uvz: Float[Tensor, "m *n 3"]) -> Float[Tensor, "m *n 3"]:
        """World points in mm of pixel coordinates and depth, the inverse of `project`; NaN where
        these are not finite.

        Raises:
            ValueError: images of another shape.
        """
        self._check_images(uvz)
        flat, known = _known(uvz.reshape(len(self), -1, 3).to(self.source))
        w = flat[..., 2:] / self.distance[:, None, None]
        across = flat[..., :2] if self.parallel else flat[..., :2] * w
        xyz = torch.cat([across, w], dim=-1) @ self.frame.mT + self.source[:, None]
        xyz = torch.where(known, xyz, torch.nan)
        return xyz.reshape(uvz.shape).to(uvz.dtype)

    def _check_images(self, uvz: Tensor) -> None:
        """Raise if images are not [m .. 3]."""
        if uvz.ndim < 2 or (uvz.shape[0], uvz.shape[-1]) != (len(self), 3):
            raise ValueError(
                f"Images of {len(self)} cameras must be [{len(self)} .. 3], (u, v, z), got "
                f"{list(uvz.shape)}"
            )

    def rays(self) -> tuple[Float[Tensor, "m v u 3"], Float[Tensor, "m v u 3"]]:
        """The points of each pixel's ray at w = 0 and w = 1, in world mm."""
        pixels = pixel_centres(self.shape).to(self.source)
        across = torch.einsum("vuk,mkx->mvux", pixels, torch.stack([self.u, self.v], dim=1))
        start = self.source[:, None, None] + (across if self.parallel else torch.zeros_like(across))
        return start, self.origin[:, None, None] + across

    def depth_range(self, grid: Grid) -> Float[Tensor, "m 2"]:
        """The least and greatest depth z in mm of a grid's box, for each camera."""
        z = self.project(grid.corners().to(self.source))[..., 2]
        return torch.stack(z.aminmax(dim=-1), dim=-1)

    def binned(self, factor: int | tuple[int, int]) -> "Cameras":
        """The same detectors with `factor` x `factor` pixels, or (rows, columns) of them, joined
        into one.
        """
        rows, columns = (factor, factor) if isinstance(factor, int) else factor
        if min(rows, columns) < 1 or self.shape[0] % rows or self.shape[1] % columns:
            raise ValueError(
                f"Binning by {factor} needs a positive factor that divides the detector, got "
                f"{self.shape}"
            )
        shape = (self.shape[0] // rows, self.shape[1] // columns)
        moved = self.shifted(self.source.new_tensor([[columns - 1, rows - 1]]) / 2)
        return replace(moved, u=self.u * columns, v=self.v * rows, shape=shape)

    def cropped(self, rows: tuple[int, int], columns: tuple[int, int]) -> "Cameras":
        """Crop detectors to rows and columns `first` to `last - 1`; pixels keep their positions."""
        for (first, last), count in zip((rows, columns), self.shape, strict=True):
            if not 0 <= first < last <= count:
                raise ValueError(
                    f"Expected rows and columns inside the detector {self.shape}, got {rows} and "
                    f"{columns}"
                )
        first = self.source.new_tensor([[columns[0], rows[0]]])
        shape = (rows[1] - rows[0], columns[1] - columns[0])
        return replace(self.shifted(first), shape=shape)

    def transposed(self) -> "Cameras":
        """Detectors with rows and columns exchanged, about the same centres."""
        rows, columns = self.shape
        half = self.source.new_tensor([[columns - rows, rows - columns]]) / 2
        return replace(self.shifted(half), shape=(columns, rows))

    def shifted(self, pixels: Float[Tensor, "#m 2"]) -> "Cameras":
        """Shift detectors in their planes by (u, v) columns and rows, all alike or each by its own.

        Raises:
            ValueError: neither [1 2] nor [m 2], or shifts that are not finite.
        """
        if pixels.shape not in ((1, 2), (len(self), 2)):
            raise ValueError(
                f"Shifts of {len(self)} detectors must be [1 2] or [{len(self)} 2] pixels, got "
                f"{list(pixels.shape)}"
            )
        column, row = pixels.split(1, dim=1)
        shift = column * self.u + row * self.v
        source = self.source + shift if self.parallel else self.source
        return replace(self, source=source, origin=self.origin + shift)

    def refined(self, factor: int) -> "Cameras":
        """Split every pixel into `factor` x `factor`; the inverse of `binned`."""
        if factor < 1:
            raise ValueError(
                f"A pixel is cut into a positive number of rays each way, got {factor}"
            )
        if factor == 1:
            return self
        u, v = self.u / factor, self.v / factor
        shift = (u + v) * (1 - factor) / 2
        shape = (self.shape[0] * factor, self.shape[1] * factor)
        source = self.source + shift if self.parallel else self.source
        return replace(self, source=source, origin=self.origin + shift, u=u, v=v, shape=shape)

    def moved(
        self,
        rotation: Float[Tensor, "3 3"] | Float[Tensor, "m 3 3"],
        translation: Float[Tensor, "3"] | Float[Tensor, "m 3"],
    ) -> "Cameras":
        """Apply a rigid motion X -> R X + t, of the world or of each camera.

        Args:
            rotation: R, one for all cameras or one for each.
            translation: shift t in mm, likewise.

        Raises:
            TypeError: not tensors of real numbers.
            ValueError: other shapes, R is not a rotation, or t is not finite.
        """
        for name, given in (("R", rotation), ("t", translation)):
            if not isinstance(given, Tensor) or given.is_complex():
                raise TypeError(f"A motion must be tensors of real numbers, got {name}={given!r}")
        R, t, m = rotation.to(self.source), translation.to(self.source), len(self)
        if R.shape not in ((3, 3), (m, 3, 3)) or t.shape not in ((3,), (m, 3)):
            raise ValueError(
                f"A motion of {m} cameras must be R [3 3] or [{m} 3 3] with t [3] or [{m} 3], got "
                f"{list(R.shape)} and {list(t.shape)}"
            )
        check_rotation(R)
        if not t.isfinite().all():
            raise ValueError(f"A translation must be finite mm, got {t.tolist()}")
        source, origin, u, v = ((getattr(self, name)[:, None] @ R.mT)[:, 0] for name in VECTORS)
        return replace(self, source=source + t, origin=origin + t, u=u, v=v)


def _known(points: Float[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n 3"], Bool[Tensor, "*n 1"]]:
    """Points with zero for non-finite ones, whose NaN would spoil gradients, and a mask of the
    finite ones.
    """
    known = points.isfinite().all(dim=-1, keepdim=True)
    return torch.where(known, points, 0.0), known


@dataclass(frozen=True, eq=False)
class ExplicitRays:
    """The segments from source to target of every pixel of M detectors, an alternative to cameras
    for a projector.

    The points are copied, except tensors that require a gradient. A ray takes 96 bytes more than
    its two points. For a flat detector `Cameras` is smaller and faster.

    Args:
        source: start of each ray, in world mm.
        target: end of each ray, in world mm.

    Raises:
        ValueError: inconsistent shapes, non-finite values, a ray of zero length.

    Examples:
        >>> z, y = torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij")
        >>> target = torch.stack([torch.full((4, 4), -50.0), y, z], dim=-1)[None]  # [m v u 3] in mm
        >>> source = target * torch.tensor([-1.0, 1.0, 1.0])
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=2.0), mv.ExplicitRays(source, target))
        >>> A(torch.ones(1, 1, 8, 8, 8)).unique()  # the length of each ray in the volume, in mm
        tensor([16.])
    """

    source: Float[Tensor, "m v u 3"]
    target: Float[Tensor, "m v u 3"]

    #: Common attributes of `Cameras`.
    parallel = None
    ray_extent = (0.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("source", "target"):
            points = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            points = points if points.requires_grad else points.clone()
            object.__setattr__(self, name, points)
            if points.ndim != 4 or points.shape[3] != 3 or not points.numel():
                raise ValueError(
                    f"Explicit rays need {name} as [m v u 3], got {list(points.shape)}"
                )
            if not points.isfinite().all():
                raise ValueError(
                    f"Explicit rays need finite mm, but {name} holds values that are NaN or "
                    f"infinite"
                )
        sizes = [(list(points.shape), str(points.device)) for points in (self.source, self.target)]
        if sizes[0] != sizes[1]:
            raise ValueError(
                f"Explicit rays need source and target of one shape on one device, got {sizes}"
            )
        short = (self.source == self.target).all(dim=-1)
        if short.any():
            raise ValueError(
                f"Explicit rays need two different ends, but {int(short.sum())} have no length"
            )

    def __len__(self) -> int:
        return len(self.source)

    @property
    def shape(self) -> tuple[int, int]:
        """Detector pixels (rows, columns)."""
        return self.source.shape[1], self.source.shape[2]

    def rays(self) -> tuple[Float[Tensor, "m v u 3"], Float[Tensor, "m v u 3"]]:
        """The start and end of each pixel's ray, in world mm."""
        return self.source, self.target
