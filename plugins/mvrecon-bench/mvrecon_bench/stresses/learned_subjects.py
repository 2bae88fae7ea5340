"""Heads and methods under stress, on small frusta and a small rig, with random weights."""

import inspect
from functools import cached_property, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.operator import Projector
from mvrecon.testing.measures import gap
from mvrecon_bench.stresses.case import DoesNotApply
from mvrecon_bench.stresses.subject import Subject

#: Distinct sizes; the detectors extend beyond the grid.
GRID = Grid.centred(size=(10, 9, 8), spacing=2.0)
#: Required options of methods, and cheaper defaults.
NEEDED = {"n_cameras": 3, "method": {"name": "sirt", "iterations": 8}}
CHEAPER = {"iterations": 8, "start": 4}


def small_rig(n_views: int = 3) -> Cameras:
    """Cone beams whose outer rays miss the grid; detector sizes are multiples of 3."""
    return circular(
        n_views, 60.0, 120.0, {"pixels": [12, 15], "pixel_mm": [5.0, 4.5]}, start_degrees=13.0
    )


class HeadSubject(Subject):
    """A head under stress."""

    @cached_property
    def frusta(self) -> Frusta:
        """Small frusta with some rays that miss the grid."""
        return Frusta.of(GRID, small_rig(), depth=10).to(self.device, self.dtype)

    @cached_property
    def head(self) -> nn.Module:
        """The head."""
        return self.build().to(self.device, self.dtype)

    @cached_property
    def given(self) -> tuple[Tensor, Tensor, Tensor]:
        """Logits and prior [2 m 1 D v u], and views [2 1 m v u] that are zero for rays that miss
        the grid.
        """
        m, (depth, v, u) = len(self.frusta.slant), self.frusta.shape
        shape = (2, m, 1, depth, v, u)
        hits = self.frusta.chord.reshape(m, v, u) > 0
        return (
            6 * self.random(*shape) - 3,
            self.random(*shape, seed=1),
            self.random(2, 1, m, v, u, seed=2) * hits,
        )


class MethodSubject(Subject):
    """A method under stress."""

    def need_module(self) -> None:
        """Raise DoesNotApply for a function: some of these use subsets of views, require counts, or
        weight a prior in the unit of the volume.
        """
        if not inspect.isclass(METHODS.get(self.name)):
            raise DoesNotApply("it is a classical method")

    def operator(self, cameras: Cameras | None = None) -> Projector:
        """The operator of the small rig or of another one."""
        return PROJECTORS.build("drr", grid=GRID, cameras=cameras or small_rig()).to(self.device)

    @cached_property
    def A(self) -> Projector:
        """The operator of the small rig."""
        return self.operator()

    def method(self, **options: Any) -> nn.Module:
        """A new method with reproducible initial weights, in evaluation mode.

        Raises:
            DoesNotApply: a required option is missing.
        """
        kind = METHODS.get(self.name)
        settings = {**self.options, **options}
        for name, parameter in inspect.signature(kind).parameters.items():
            if name in settings:
                continue
            if name in CHEAPER and isinstance(parameter.default, int):
                settings[name] = CHEAPER[name]
            elif inspect.isclass(kind) and parameter.default is parameter.empty:
                if name not in NEEDED:
                    raise DoesNotApply(
                        f"it needs {name}; stress it as "
                        f"{{kind: method, name: {self.name}, {name}: ..}}"
                    )
                settings[name] = NEEDED[name]
        torch.manual_seed(0)
        method = build_method({"name": self.name, **settings})
        return method.to(self.device, self.dtype).eval()

    def stirred(self, **options: Any) -> nn.Module:
        """A new method with random weights, also in layers initialised with zeros."""
        method, rng = self.method(**options), torch.Generator().manual_seed(1)
        with torch.no_grad():
            for parameter in method.parameters():
                parameter += 0.1 * torch.randn(parameter.shape, generator=rng).to(parameter)
        return method

    @cached_property
    def used(self) -> "partial[Reconstruction]":
        """Such a method with the operator of the small rig, shared by cases that do not modify
        it.

        Raises:
            DoesNotApply: the method does not support the small rig.
        """
        method = self.stirred()
        self.accepts(method, self.views[:1], self.A)
        return partial(method, A=self.A)

    def accepts(self, method: nn.Module, views: Tensor, A: Projector) -> Reconstruction:
        """The reconstruction from valid views.

        Raises:
            DoesNotApply: the method does not support the rig.
        """
        try:
            return method(views, A)
        except ValueError as error:
            raise DoesNotApply(f"it refuses this rig: {error}") from error

    @cached_property
    def truth(self) -> Float[Tensor, "3 1 d h w"]:
        """Three blobs, one per camera."""
        volume = torch.zeros(3, 1, *GRID.shape, dtype=self.dtype, device=self.device)
        volume[:, :, 2:6, 2:7, 3:8] = 0.5 + self.random(3, 1, 4, 5, 5)
        return volume

    @cached_property
    def views(self) -> Float[Tensor, "3 1 m v u"]:
        """Their views."""
        return self.A(self.truth)

    @cached_property
    def scales(self) -> bool:
        """Whether the method is scale-equivariant, determined with a factor of 8."""
        with torch.no_grad():
            volume, other = (self.used(scale * self.views[:1]).volume for scale in (1, 8))
        return gap(other / 8, volume) < 1e-3
