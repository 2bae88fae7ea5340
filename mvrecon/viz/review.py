"""The sheets of a review: planes, projections, slices, views, per-view estimates and weights of
cameras, with fixed scales of values.

Convention: [d h w] = (z, y, x); letters at the edges say where the patient's right (R), left (L),
front (A), back (P), head (H) and feet (F) are.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.viz.planes import Image, brightest, letters, middle_planes
from mvrecon.viz.sheet import Column, Panel, Scale, sheet

PLANES, ALONG = ("across z", "across y", "across x"), ("along z", "along y", "along x")
#: The most cameras on a sheet.
CAMERAS = 8
Volumes = Mapping[str, Float[Tensor, "d h w"]]


class Case(NamedTuple):
    """What a sheet of a case is headed with, and how its values are shown.

    Args:
        name: of the case.
        grid: of its volumes; its letters hold for coarser volumes of the same box.
        data_range: values of volumes go from 0 to it.
        unit: of the volumes.
        unit_of_views: of the views.
    """

    name: str
    grid: Grid
    data_range: float
    unit: str = ""
    unit_of_views: str = ""

    def value(self, share: float = 1.0, name: str = "value") -> Scale:
        """Scale of values from 0 to a share of the range."""
        return Scale(0.0, share * self.data_range, _named(name, self.unit))

    def error(self, share: float, name: str = "error") -> Scale:
        """Scale of signed values up to a share of the range."""
        return Scale(-share * self.data_range, share * self.data_range, _named(name, self.unit))

    def panels(self, volume: Float[Tensor, "d h w"], scale: Scale) -> list[Panel]:
        """The three middle planes."""
        return self._panels(middle_planes(volume, self.grid.spacing), scale)

    def _panels(self, pixels: Sequence[Tensor], scale: Scale) -> list[Panel]:
        edges = letters(self.grid)
        return [Panel(p, scale, e) for p, e in zip(pixels, edges, strict=True)]


def planes(
    case: Case,
    truth: Float[Tensor, "d h w"],
    volumes: Volumes,
    marked: Float[Tensor, "d h w"] | None = None,
) -> Image:
    """Three middle planes of the truth and of every volume, each above its error, to scale.

    Values from 0 to the case's range; errors, volume - truth, to a fourth of it.

    Args:
        case: its grid and range.
        truth: the values that were to be reconstructed.
        volumes: by name; further lines of a name, such as figures, are shown below it.
        marked: the truth with a support's outline, shown in its place.
    """
    value, error = case.value(), case.error(0.25, "error, volume - truth")
    first = case.panels(truth if marked is None else marked, value)
    columns = [Column("truth", _spread(first, [None] * 3))]
    for name, volume in volumes.items():
        columns.append(
            Column(name, _spread(case.panels(volume, value), case.panels(volume - truth, error)))
        )
    return sheet(case.name, columns, _spread(PLANES, ("error",) * 3))


def slices(case: Case, truth: Float[Tensor, "d h w"], volumes: Volumes, z: int) -> Image:
    """One plane across z of the truth and of every volume above its error, to scale; see
    `planes`.
    """
    value, error = case.value(), case.error(0.25, "error, volume - truth")
    at = slice(z, z + 1)
    columns = [Column("truth", [case.panels(truth[at], value)[0], None])]
    for name, volume in volumes.items():
        both = case.panels(volume[at], value)[0], case.panels((volume - truth)[at], error)[0]
        columns.append(Column(name, both))
    return sheet(f"{case.name}, slice {z + 1} of {len(truth)}", columns, ("across z", "error"))


def projections(case: Case, truth: Float[Tensor, "d h w"], volumes: Volumes) -> Image:
    """Maximum-intensity projections of the truth and of every volume along three axes, to scale."""
    columns = [
        Column(name, case._panels(brightest(volume, case.grid.spacing), case.value(name="maximum")))
        for name, volume in {"truth": truth, **volumes}.items()
    ]
    return sheet(case.name, columns, ALONG)


def scan(case: Case, volume: Float[Tensor, "d h w"]) -> Image:
    """The three middle planes of a volume side by side, to scale, from 0 or its least value to its
    greatest.
    """
    low, high = min(0.0, volume.min().item()), volume.max().item()
    high = max(high, low + torch.finfo(torch.float32).tiny)
    panels = case.panels(volume, Scale(low, high, _named("value", case.unit)))
    columns = [Column(name, [panel]) for name, panel in zip(PLANES, panels, strict=True)]
    return sheet(case.name, columns, ("",))


def views(
    measured: Float[Tensor, "m v u"], predicted: Float[Tensor, "m v u"], name: str = "", unit=""
) -> Image:
    """Measured and predicted views of the cameras and their difference, with its NRMSE; of many
    cameras, `CAMERAS` at equal steps.

    Values from 0 to the greatest measured value; the difference to a tenth of it.
    """
    top = max(measured.amax().item(), torch.finfo(torch.float32).tiny)
    value = Scale(0.0, top, _named("view", unit))
    apart = Scale(-top / 10, top / 10, _named("difference", unit))
    columns = []
    for m in _chosen(len(measured)):
        y, p = measured[m], predicted[m]
        error = ((p - y).norm() / y.norm().clamp(min=torch.finfo(torch.float32).tiny)).item()
        panels = [Panel(y, value), Panel(p, value), Panel(p - y, apart)]
        columns.append(Column(f"camera {m}\n{error:.3f}", panels))
    title = f"{name}: NRMSE of views{_left_out(len(columns), len(measured))}"
    return sheet(title, columns, ("measured", "predicted", "difference"))


def per_view(case: Case, volumes: Float[Tensor, "m d h w"]) -> Image:
    """Three middle planes of the mean of the cameras' volumes, and of how each camera's own differs
    from it, to scale.

    The mean from 0 to the range; a difference to an eighth of it, blue to red.
    """
    mean, apart = volumes.mean(dim=0), case.error(1 / 8, "estimate - mean")
    columns = [Column("mean", case.panels(mean, case.value(name="mean")))]
    for m in _chosen(len(volumes), CAMERAS - 1):
        columns.append(Column(f"camera {m}", case.panels(volumes[m] - mean, apart)))
    return sheet(
        f"{case.name}: per-view estimates{_left_out(len(columns) - 1, len(volumes))}",
        columns,
        PLANES,
    )


def uncertainty(case: Case, error: Float[Tensor, "d h w"], sigma: Float[Tensor, "d h w"]) -> Image:
    """Three middle planes of the size of a volume's error and of its expected standard deviation,
    to scale, both from 0 to an eighth of the range.
    """
    scale = case.value(1 / 8, "|error| and sigma")
    shown = {"|error|": error.abs(), "sigma": sigma}
    columns = [Column(name, case.panels(volume, scale)) for name, volume in shown.items()]
    return sheet(case.name, columns, PLANES)


def weights(case: Case, volumes: Float[Tensor, "m d h w"]) -> Image:
    """Three middle planes of every camera's weight, to scale.

    Values from 0 to 3 / M, so that a camera that counts as much as the others is at one third.
    """
    scale = Scale(0.0, 3 / len(volumes), "weight (one third: equal)")
    columns = [Column(f"camera {m}", case.panels(volumes[m], scale)) for m in _chosen(len(volumes))]
    title = f"{case.name}: weights of cameras{_left_out(len(columns), len(volumes))}"
    return sheet(title, columns, PLANES)


def _chosen(count: int, most: int = CAMERAS) -> list[int]:
    """At most so many of the cameras, at equal steps."""
    shown = min(count, most)
    return [k * count // shown for k in range(shown)]


def _left_out(shown: int, count: int) -> str:
    """What a title adds where a sheet has not all cameras."""
    return f", {shown} of {count} cameras" if shown < count else ""


def _spread(first: Sequence, second: Sequence) -> list:
    return [item for pair in zip(first, second, strict=True) for item in pair]


def _named(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name
