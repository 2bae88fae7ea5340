"""A registered camera under stress, built with small options for all that it needs."""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.files import save
from mvrecon.geometry.cameras.rigs import circular
from mvrecon_bench.stresses.case import DoesNotApply
from mvrecon_bench.stresses.subject import DETECTOR, Subject

#: What a camera gets that asks for it by this name, has no default for it and was not given it.
SMALL = {
    "n_views": 3,
    "sid": 40.0,
    "sdd": 70.0,
    "radius": 30.0,
    "focal": 20.0,
    "aperture_degrees": 120.0,
    "detector": DETECTOR,
}
#: The same, where it has a default that may be large.
PIXELS = 5


class CameraSubject(Subject):
    """A camera under stress, with small options for all that it needs and was not given."""

    @contextmanager
    def given(self) -> Iterator[dict[str, Any]]:
        """The options that it is built with; a file among them is there for as long.

        Raises:
            DoesNotApply: it needs an option of another name than `SMALL` has.
        """
        with TemporaryDirectory() as folder:
            yield {**self._small(Path(folder)), **self.options}

    def _small(self, folder: Path) -> dict[str, Any]:
        parameters = inspect.signature(CAMERAS.get(self.name)).parameters
        if self.name == "from_file":
            save(circular(3, SMALL["sid"], SMALL["sdd"], DETECTOR), folder / "rig.json")
            return {"path": folder / "rig.json"}
        options = (
            {"pixels": PIXELS}
            if "pixels" in parameters and isinstance(parameters["pixels"].default, int)
            else {}
        )
        for name, parameter in parameters.items():
            if parameter.default is parameter.empty and name not in self.options:
                if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                    continue
                if name not in SMALL:
                    raise DoesNotApply(
                        f"it needs {name}; stress it as "
                        f"{{kind: camera, name: {self.name}, {name}: ..}}"
                    )
                options[name] = SMALL[name]
        return options

    @cached_property
    def cameras(self) -> Cameras:
        """The rig, in float64 on the device.

        Raises:
            DoesNotApply: a plugin's camera refuses small options that it was not given by the user.
        """
        with self.given() as options:
            try:
                return self.build(**options).to(self.device)
            except (TypeError, ValueError) as error:
                if (
                    CAMERAS.origin(self.name).startswith("mvrecon.")
                    or options.keys() <= self.options.keys()
                ):
                    raise
                raise DoesNotApply(
                    f"it takes no {options}; stress it with options of its own: {error}"
                ) from error

    @cached_property
    def few(self) -> Cameras:
        """Three of its cameras, the same one again where it has fewer."""
        return self.cameras[[m % len(self.cameras) for m in range(3)]]

    @property
    def side(self) -> float:
        """The sign of the depth of what a camera looks at."""
        return -1.0 if self.cameras.extent == "behind" else 1.0

    def somewhere(self, count: int = 20) -> Float[Tensor, "3 n 3"]:
        """Pixel coordinates and depths on the part of each ray of `few` that counts, in float64."""
        rig, rng = self.few, torch.Generator().manual_seed(0)
        t = torch.rand(len(rig), count, 3, generator=rng, dtype=torch.float64).to(self.device)
        uv = t[..., :2] * t.new_tensor(rig.shape[::-1]) - 0.5
        z = self.side * (0.1 + 0.8 * t[..., 2:]) * rig.distance[:, None, None]
        return torch.cat([uv, z], dim=-1)
