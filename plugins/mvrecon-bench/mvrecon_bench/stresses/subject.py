"""A part under stress: its name and options, on a device and in a dtype."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import REGISTRIES
from mvrecon.geometry.cameras.camera import VECTORS, Cameras, Extent
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon_bench.stresses.case import DoesNotApply, inapplicable

#: Distinct sizes and spacings, centred off the origin.
GRID = Grid.centred(size=(7, 6, 5), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
BEAMS: tuple[tuple[bool, Extent], ...] = ((False, "segment"), (True, "segment"), (False, "behind"))
#: Properties that every projector or method is assumed to have; a plugin's class opts out by
#: setting the attribute of this name to False.
CLAIMS = {
    "matched": "its adjoint is not the transpose of its forward",
    "local": "a NaN in the volume spreads beyond the rays through its voxel",
    "pixelwise": "a pixel's value depends on its neighbours', too, as where a detector blurs",
    "bits": "its rays are rounded, so that sums which are exact in floating point are not to the "
    "last bit",
    "averages": "copies of a view change the volume, as its networks see A divided by its norm",
}
DETECTOR = {"pixels": [6, 5], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}


@dataclass(frozen=True, eq=False)
class Subject:
    """A part under stress.

    Args:
        kind: kind of part; "mvrecon" has no part.
        name: name in that registry.
        options: options of the part.
        device: device of the part.
        dtype: dtype of volumes and views.
    """

    kind: str
    name: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    dtype: torch.dtype = torch.float32

    @property
    def label(self) -> str:
        """A short label, unique per set of options."""
        options = (f"{key}={value}" for key, value in self.options.items())
        return " ".join([self.name or self.kind, *options])

    @property
    def ours(self) -> bool:
        """Whether the part belongs to mvrecon and must support inputs that plugins may reject."""
        return REGISTRIES[self.kind].origin(self.name).startswith("mvrecon.")

    @property
    def parameters(self) -> Mapping[str, inspect.Parameter]:
        """The parameters of the part's constructor."""
        return inspect.signature(REGISTRIES[self.kind].get(self.name)).parameters

    def build(self, **options: Any) -> Any:
        """Build the part with its options and those of a case."""
        return REGISTRIES[self.kind].build(self.name, **{**self.options, **options})

    def completed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values of the required options that the user does not set.

        Raises:
            DoesNotApply: an option has no value.
        """
        varied = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        missing = [
            name
            for name, one in self.parameters.items()
            if one.default is one.empty and one.kind not in varied and name not in self.options
        ]
        for name in missing:
            if name not in values:
                raise DoesNotApply(
                    f"it needs {name}; stress it as "
                    f"{{kind: {self.kind}, name: {self.name}, {name}: ..}}"
                )
        return {name: values[name] for name in missing}

    def random(self, *shape: int, seed: int = 0) -> Tensor:
        """Uniform random values in [0, 1), exactly representable in the dtype."""
        rng = torch.Generator().manual_seed(seed)
        return torch.rand(*shape, generator=rng, dtype=torch.float64).to(self.dtype).to(self.device)

    def need(self, claim: str) -> None:
        """Raise DoesNotApply if a plugin's class opts out of a property; see `CLAIMS`."""
        if not self.ours and not getattr(REGISTRIES[self.kind].get(self.name), claim, True):
            raise DoesNotApply(f"it declares that {CLAIMS[claim]}")


class ProjectorSubject(Subject):
    """A projector under stress, with geometries of the beam that it supports."""

    def projector(self, grid: Grid, cameras: Cameras, **options: Any) -> Any:
        """The operator, on the device.

        Raises:
            DoesNotApply: a plugin's projector does not support this geometry.
        """
        with inapplicable(self.ours, "it refuses"):
            return self.build(grid=grid, cameras=cameras, **options).to(self.device)

    @cached_property
    def beam(self) -> tuple[bool, Extent]:
        """Whether the rays are parallel, and their extent.

        Raises:
            DoesNotApply: the projector supports none of the known beams.
        """
        refusals = []
        for beam in BEAMS:
            try:
                A = self.build(grid=GRID, cameras=rig_about(GRID, *beam)).to(self.device)
            except ValueError as error:
                refusals.append(str(error))
            else:
                with inapplicable(self.ours, "it refuses this dtype"):
                    A(self.random(1, 1, *GRID.shape))
                return beam
        raise DoesNotApply(f"it takes no rig of this plan: {'; '.join(refusals)}")

    @cached_property
    def error_of_ones(self) -> float:
        """Relative error of the length of a ray in a box of ones."""
        grid = Grid.centred((16, 16, 16), 1.0)
        start = torch.tensor([[-30.0, 0.3, 0.4]], dtype=torch.float64)
        ones = torch.ones(1, 1, 16, 16, 16, device=self.device)
        length = self.projector(grid, self.rays(start, -start))(ones)
        expected = 16 * float((2 * start).norm()) / 60
        return abs(float(length) - expected) / expected

    @cached_property
    def of_cells(self) -> bool:
        """Whether a voxel contributes exactly the intersection length of the ray, so that chords of
        a box are exact.
        """
        grid = Grid.centred((4, 4, 4), 1.0)
        start, end = torch.tensor([[[-9.0, -2.3, 0.7]], [[9.0, 5.9, -0.9]]], dtype=torch.float64)
        enter, leave = 7 / 18, (2 + 2.3) / 8.2  # close to the face x = -2, and to y = 2
        length = (leave - enter) * float((end - start).norm())
        return abs(float(self.values(grid, start, end)) / length - 1) < 1e-4

    def need_lines(self) -> None:
        """Raise DoesNotApply unless its views are line integrals in mm without other factors."""
        if not self.error_of_ones < 0.02:
            raise DoesNotApply("its views are no plain line integrals")

    def need_exact(self) -> None:
        """Raise DoesNotApply unless its line integrals of ones are exact, unlike those by sampling
        along a ray.
        """
        self.need_lines()
        if not self.error_of_ones < 1e-4:
            raise DoesNotApply("it takes samples along a ray; case 31 tells of their order")

    def need_segment(self) -> None:
        """Raise DoesNotApply unless the projector's rays are segments from source to pixel."""
        if self.beam[1] != "segment":
            raise DoesNotApply(f"its rays are of extent {self.beam[1]!r}")

    def rig(
        self, grid: Grid = GRID, detector: Mapping[str, Any] | None = None, n_views: int = 3
    ) -> Cameras:
        """A rig in a generic pose that sees the grid, scaled to its size."""
        return rig_about(grid, *self.beam, detector=detector, n_views=n_views)

    def posed(self, grid: Grid, cameras: Cameras) -> tuple[Callable[..., Tensor], list[Tensor]]:
        """Views as a function of volumes and camera vectors, and the vectors, which require a
        gradient.

        Raises:
            DoesNotApply: the projector does not support cameras that require a gradient.
        """
        vectors = [getattr(cameras, name).clone().requires_grad_() for name in VECTORS]

        def projector(*vectors: Any) -> Any:
            rig = replace(cameras, **dict(zip(VECTORS, vectors, strict=True)))
            return self.projector(grid, rig)

        with inapplicable(False, "it refuses"):
            projector(*vectors)
        return lambda volume, *vectors: projector(*vectors)(volume), vectors

    def pair(
        self, grid: Grid = GRID, batch: int = 1, channels: int = 1, **rig: Any
    ) -> tuple[Any, Tensor, Tensor]:
        """The operator of a grid and its rig, a random volume and random views."""
        A = self.projector(grid, cameras := self.rig(grid, **rig))
        x = self.random(batch, channels, *grid.shape)
        return A, x, self.random(batch, channels, len(cameras), *cameras.shape, seed=1)

    def rays(self, start: Float[Tensor, "m 3"], end: Float[Tensor, "m 3"]) -> Cameras:
        """One single-pixel camera per ray from `start` to `end` (mm); the ray of a pinhole extends
        beyond `end`.
        """
        is_parallel, extent = self.beam
        look = (end - start) / (end - start).abs().amax(dim=-1, keepdim=True)  # of any length
        axis = torch.nn.functional.one_hot(look.abs().argmin(dim=-1), 3).to(look)
        u = torch.nn.functional.normalize(torch.linalg.cross(axis, look), dim=-1)
        v = torch.nn.functional.normalize(torch.linalg.cross(look, u), dim=-1)
        target = start - (end - start) if extent == "behind" else end
        return Cameras(start, target, u, v, (1, 1), is_parallel, extent)

    def values(
        self, grid: Grid, start: Tensor, end: Tensor, volume: Tensor | None = None
    ) -> Float[Tensor, " m"]:
        """Integral of a volume [d h w] (default: ones) along each ray, in float64."""
        x = torch.ones(grid.shape, dtype=self.dtype) if volume is None else volume
        views = self.projector(grid, self.rays(start, end))(x.to(self.device)[None, None])
        return views.flatten().double().cpu()


def rig_about(
    grid: Grid,
    is_parallel: bool = False,
    extent: Extent = "segment",
    detector: Mapping[str, Any] | None = None,
    n_views: int = 3,
) -> Cameras:
    """A rig in a generic pose about a grid's centre, designed for `GRID` and scaled to the given
    grid.
    """
    scale = _radius(grid) / _radius(GRID)
    scaled: dict[str, Any] = dict(detector or DETECTOR)
    for length in ("pixel_mm", "offset_mm"):
        value = scaled.get(length, 0.0)
        scaled[length] = [mm * scale for mm in value] if isinstance(value, list) else value * scale
    if is_parallel:
        rig = parallel(n_views, scaled, 60.0 * scale, start_degrees=11.0)
    elif extent == "behind":
        return dome(n_views, 30.0 * scale, 20.0 * scale, 120.0, scaled, target=grid.centre.tolist())
    else:
        rig = circular(n_views, 40.0 * scale, 70.0 * scale, scaled, start_degrees=13.0)
    return rig.moved(torch.eye(3), grid.centre)


def _radius(grid: Grid) -> float:
    return float((grid.corners() - grid.centre).norm(dim=-1).max())
