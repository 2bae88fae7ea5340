"""A registered camera under stress, built with small values of its required options."""

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

#: Values of required options that the user does not set, by option name.
SMALL = {
    "n_views": 3,
    "sid": 40.0,
    "sdd": 70.0,
    "radius": 30.0,
    "focal": 20.0,
    "aperture_degrees": 120.0,
    "detector": DETECTOR,
}
#: Values of options whose defaults may be large.
PIXELS = 5


class CameraSubject(Subject):
    """A camera under stress, with small values of the required options that the user does not
    set.
    """

    @contextmanager
    def given(self) -> Iterator[dict[str, Any]]:
        """Context with the options of the camera; a file among them exists within the context.

        Raises:
            DoesNotApply: the camera requires an option that is not in `SMALL`.
        """
        with TemporaryDirectory() as folder:
            yield {**self._small(Path(folder)), **self.options}

    def _small(self, folder: Path) -> dict[str, Any]:
        parameters = inspect.signature(CAMERAS.get(self.name)).parameters
        if self.name == "from_file":
            save(circular(3, SMALL["sid"], SMALL["sdd"], DETECTOR), folder / "rig.json")
            return {"path": folder / "rig.json"}
        options: dict[str, Any] = (
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
            DoesNotApply: a plugin's camera rejects the small options that the user did not set.
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
