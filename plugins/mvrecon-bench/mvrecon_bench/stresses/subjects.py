"""Cameras, scenes, heads and methods under stress, built with small values of the options that the
user does not set.
"""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.files import save
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.methods.method import Reconstruction, build_method
from mvrecon.operators.operator import Projector
from mvrecon.testing.measures import gap
from mvrecon.testing.scene import GRID as FIELD, RIG
from mvrecon_bench.stresses.case import DoesNotApply, inapplicable
from mvrecon_bench.stresses.subject import DETECTOR, ProjectorSubject, Subject

#: Values of required options of cameras.
SMALL: dict[str, Any] = {
    **{"n_views": 3, "sid": 40.0, "sdd": 70.0, "radius": 30.0, "focal": 20.0},
    **{"aperture_degrees": 120.0, "detector": DETECTOR},
}
#: Details of scenes finer than the grid are replaced.
COARSER = {"well_diameters": [14, 13, 12, 11, 10, 9]}
#: Required options of methods, and cheaper defaults.
NEEDED = {"n_cameras": 3, "method": {"name": "sirt", "iterations": 8}}
CHEAPER = {"iterations": 8, "start": 4}
#: Of heads and methods: distinct sizes; the detectors extend beyond the grid.
GRID = Grid.centred(size=(10, 9, 8), spacing=2.0)


class CameraSubject(Subject):
    """A camera under stress."""

    @contextmanager
    def given(self) -> Iterator[dict[str, Any]]:
        """Context with the options of the camera; a file among them exists within the context.

        Raises:
            DoesNotApply: the camera requires an option that is not in `SMALL`.
        """
        with TemporaryDirectory() as folder:
            path, pixels = Path(folder) / "rig.json", self.parameters.get("pixels")
            if file := self.name == "from_file":
                save(circular(3, SMALL["sid"], SMALL["sdd"], DETECTOR), path)
            few = {"pixels": 5} if pixels and isinstance(pixels.default, int) else {}
            small = SMALL | ({"path": path} if file else {})
            yield {**few, **self.completed(small), **self.options}

    @cached_property
    def cameras(self) -> Cameras:
        """The rig, in float64 on the device.

        Raises:
            DoesNotApply: a plugin's camera rejects the small options that the user did not set.
        """
        with self.given() as options:
            own = self.ours or options.keys() <= self.options.keys()
            with inapplicable(own, f"it takes no {options}; stress it with options of its own"):
                return self.build(**options).to(self.device)

    @cached_property
    def few(self) -> Cameras:
        """Three of its cameras, with repetitions if it has fewer."""
        return self.cameras[[m % len(self.cameras) for m in range(3)]]

    @property
    def side(self) -> float:
        """Sign of the depth of visible points."""
        return -1.0 if self.cameras.extent == "behind" else 1.0

    def somewhere(self, count: int = 20) -> Float[Tensor, "3 n 3"]:
        """Pixel coordinates and depths within the extent of each ray of `few`, in float64."""
        rig, rng = self.few, torch.Generator().manual_seed(0)
        t = torch.rand(len(rig), count, 3, generator=rng, dtype=torch.float64).to(self.device)
        uv = t[..., :2] * t.new_tensor(rig.shape[::-1]) - 0.5
        z = self.side * (0.1 + 0.8 * t[..., 2:]) * rig.distance[:, None, None]
        return torch.cat([uv, z], dim=-1)


class SceneSubject(Subject):
    """A scene under stress, on the small grid and rig of `mvrecon.testing.check_scene`."""

    def scene(self) -> Scene:
        """Build a new scene.

        Raises:
            DoesNotApply: a required option is missing, such as the path of a file.
        """
        self.completed({})
        return self.build(**self.coarser)

    @cached_property
    def coarser(self) -> dict[str, Any]:
        """The options in `COARSER` that the scene has and the user does not set."""
        free = set(self.parameters) - set(self.options)
        return {key: value for key, value in COARSER.items() if key in free}

    @cached_property
    def used(self) -> Scene:
        """A shared scene, for cases that do not require a new one."""
        return self.scene()

    def sample(
        self, index: int = 0, cameras: Cameras = RIG, of: Scene | None = None, seed: int = 3
    ) -> Sample:
        """A case of the series.

        Raises:
            DoesNotApply: the scene does not support the grid, for example because of its fixed
                size.
        """
        try:
            return (of or self.used).sample(index, seed, FIELD, cameras)
        except ValueError as error:
            if "grid" not in str(error):
                raise
            raise DoesNotApply(f"it refuses the plan's grid: {error}") from error

    def need_whole(self) -> None:
        """Raise DoesNotApply unless the object is inside the grid."""
        inside = self.sample().inside
        if inside.sum() > inside[0, 1:-1, 1:-1, 1:-1].sum():
            raise DoesNotApply("its object reaches beyond the plan's grid of 120 mm")

    def need_two(self) -> None:
        """Raise DoesNotApply unless the scene has a second case."""
        if self.used.length == 1:
            raise DoesNotApply("it has one case")


def small_rig() -> Cameras:
    """Cone beams whose outer rays miss the grid; detector sizes are multiples of 3."""
    detector = {"pixels": [12, 15], "pixel_mm": [5.0, 4.5]}
    return circular(3, 60.0, 120.0, detector, start_degrees=13.0)


class HeadSubject(Subject):
    """A head under stress, on small frusta of which some rays miss the grid."""

    @cached_property
    def frusta(self) -> Frusta:
        """The frusta."""
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
        logits, prior = (self.random(2, m, 1, depth, v, u, seed=seed) for seed in (0, 1))
        hits = self.frusta.chord.reshape(m, v, u) > 0
        return 6 * logits - 3, prior, self.random(2, 1, m, v, u, seed=2) * hits


class MethodSubject(Subject):
    """A method under stress, with random weights."""

    @property
    def is_module(self) -> bool:
        """Whether the method is a class, which the cases may build in any state."""
        return inspect.isclass(METHODS.get(self.name))

    def need_module(self) -> None:
        """Raise DoesNotApply for a function: some of these use subsets of views, require counts, or
        weight a prior in the unit of the volume.
        """
        if not self.is_module:
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
        cheaper = {
            name: value
            for name, value in CHEAPER.items()
            if name in self.parameters and isinstance(self.parameters[name].default, int)
        }
        needed = self.completed(NEEDED | options) if self.is_module else {}
        torch.manual_seed(0)
        settings = {"name": self.name, **cheaper, **needed, **self.options, **options}
        return build_method(settings).to(self.device, self.dtype).eval()

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
        with inapplicable(False, "it refuses this rig"):
            return method(views, A)

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


SUBJECTS = {
    **{"projector": ProjectorSubject, "camera": CameraSubject, "scene": SceneSubject},
    **{"head": HeadSubject, "method": MethodSubject, "mvrecon": Subject},
}


def subject_of(kind: str, *arguments: Any) -> Subject:
    """Build a subject of a kind; see `Subject` for the arguments."""
    return SUBJECTS[kind](kind, *arguments)
