"""One model on the operators of single cases, which differ in what attenuates."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.calibration.alignment import Alignment
from mvrecon.data.resample import resample
from mvrecon.engine.on_rig import OnRig, with_weights_of
from mvrecon.geometry.grid import Grid
from mvrecon.models.output import Reconstruction
from mvrecon.parts import PROJECTORS
from mvrecon.projectors.operator import Projector, Wrapped
from mvrecon.registry import check_options

#: What a projector's option `mu` may say in place of a map, and the map of a case that it means.
MAPS = {"case": "mu", "measured": "mu_measured"}


@dataclass(frozen=True)
class CaseAttenuation:
    """Linear attenuation in 1/mm that a projector takes from each case.

    Args:
        name: of the case's map, "mu" or "mu_measured".
        shift_mm: how far the map has moved against the case, along (x, y, z).
    """

    name: str
    shift_mm: tuple[float, ...] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, projector: Mapping[str, Any]) -> "CaseAttenuation | None":
        """What the option `mu` of a projector says: "case", "measured", or `{of: case, shift_mm:
        [x, y, z]}`; None where it names no map of a case.

        Raises:
            TypeError: a mapping with other keys.
            ValueError: a map that no case has, or a shift that is not three finite numbers.
        """
        value = projector.get("mu")
        if not isinstance(value, Mapping):
            return cls(MAPS[value]) if isinstance(value, str) and value in MAPS else None
        check_options("projector.mu", value, ("of", "shift_mm"))
        name = value.get("of", "case")
        shift = tuple(float(step) for step in value.get("shift_mm", cls.shift_mm))
        if name not in MAPS or len(shift) != 3 or not torch.tensor(shift).isfinite().all():
            raise ValueError(
                f"Expected projector.mu of case or measured, and a shift_mm of three finite "
                f"numbers, got {dict(value)}"
            )
        return cls(MAPS[name], shift)

    def maps_of(self, batch: Mapping[str, Any], grid: Grid) -> list[Float[Tensor, "d h w"]]:
        """The maps of the cases of a batch in 1/mm, moved.

        Raises:
            ValueError: cases without the map.
        """
        if self.name not in batch:
            scenes = {"mu": "cardiac or nema", "mu_measured": "spect_ct"}[self.name]
            raise ValueError(
                f"Expected cases with {self.name!r} for this projector.mu, as of the scene "
                f"{scenes}, got {sorted(batch)}"
            )
        maps = [mu[0].cpu() for mu in batch[self.name]]
        if not any(self.shift_mm):
            return maps
        affine = grid.affine.clone()
        affine[:3, 3] += torch.tensor(self.shift_mm, dtype=affine.dtype)
        moved = Grid(grid.shape, affine)
        return [resample(mu, moved, grid).clamp_min(0) for mu in maps]


class OwnAttenuation(Wrapped):
    """Projectors of cases with attenuation of their own, in the unit of their views.

    It is none itself: `of_cases` makes those of a batch.

    Args:
        A: the same without attenuation; it gives the grid, the rig and the sizes.
        options: name and options of the projector.
        attenuation: what its option `mu` says.
    """

    A: Projector

    def __init__(self, A: Projector, options: Mapping[str, Any], attenuation: CaseAttenuation):
        super().__init__(A)
        self.options, self.maps = dict(options), attenuation

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Refused: which case?"""
        raise TypeError("Expected the projector of a case, see of_cases: mu is each case's own")

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Refused, as `forward`."""
        return self.forward(y)

    def of_cases(self, batch: Mapping[str, Any]) -> Iterator[tuple[Projector, dict[str, Any]]]:
        """The projector of each case of a batch, one after the other, with its name and options.

        Raises:
            ValueError: cases without the map.
        """
        for mu in self.maps.maps_of(batch, self.grid):
            settings = {**self.options, "mu": mu}
            A = PROJECTORS.from_config(settings, grid=self.grid, cameras=self.cameras)
            yield A.to(self.device), settings


@dataclass(eq=False)
class OnCases:
    """One model on the operators of the cases of a batch, one case after the other.

    Args:
        cases: the model on the rig, with the operator of each case.
    """

    cases: list[OnRig]

    def _each(self, act: Callable[[OnRig, Tensor], Any], values: Tensor) -> list[Any]:
        return [act(one, value) for one, value in zip(self.cases, values.split(1), strict=True)]

    def A(self, volumes: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b 1 m v u"]:
        """The views of volumes."""
        return torch.cat(self._each(lambda one, x: one.A(x), volumes))

    def corrected(self, volumes: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b 1 n v u"]:
        """The views of volumes as the model corrects them."""
        return torch.cat(self._each(lambda one, x: one.corrected(x), volumes))

    def model(self, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        """What the model makes of views."""
        return joined(self._each(lambda one, y: one.model(y), views))

    def by(self, name: str, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        """What a model without training makes of views."""
        return joined(self._each(lambda one, y: one.by(name, y), views))


def on_cases(rig: OnRig, batch: Mapping[str, Any]) -> OnRig | OnCases:
    """A model for a batch: on its rig, or where the operator is each case's own, on those.

    Raises:
        ValueError: cases without the map.
    """
    if not isinstance(rig.A, OwnAttenuation):
        return rig
    training, cases = rig.model.training, []
    for A, settings in rig.A.of_cases(batch):
        model = with_weights_of(rig.model, rig.options, A).to(A.device).train(training)
        cases.append(OnRig(A, model, settings, rig.options))
    return OnCases(cases)


def reconstructed(method: nn.Module | OnRig, batch: Mapping[str, Any]) -> Reconstruction:
    """What a method makes of a batch's views, by the operators of its cases."""
    if isinstance(method, OnRig):
        return on_cases(method, batch).model(batch["views"])
    return method(batch["views"])


def projected(
    A: Projector, volumes: Float[Tensor, "b 1 d h w"], batch: Mapping[str, Any]
) -> Float[Tensor, "b 1 m v u"]:
    """The views of volumes, by the operators of a batch's cases."""
    if not isinstance(A, OwnAttenuation):
        return A(volumes)
    pairs = zip(A.of_cases(batch), volumes.split(1), strict=True)
    return torch.cat([one(volume) for (one, _), volume in pairs])


def plain(A: Projector) -> Projector:
    """What a model is built on: where mu is each case's own, the operator without it."""
    return A.A if isinstance(A, OwnAttenuation) else A


def singly(batch: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The cases of a batch, each as a batch of one."""
    count = len(batch["views"])
    return [{key: value[i : i + 1] for key, value in batch.items()} for i in range(count)]


def joined(parts: Iterable[Reconstruction]) -> Reconstruction:
    """Reconstructions of single cases as that of a batch."""
    outs, together = list(parts), {}
    for name in (field.name for field in fields(Reconstruction)):
        values = [getattr(out, name) for out in outs]
        first = values[0]
        if isinstance(first, tuple):
            together[name] = tuple(torch.cat(one) for one in zip(*values, strict=True))
        elif isinstance(first, Alignment):
            together[name] = Alignment.joined(values)
        elif first is not None and name != "visible":
            together[name] = torch.cat(values)
        else:  # which voxels each camera's frustum holds: the same for all
            together[name] = first
    return Reconstruction(**together)
