"""The cross-view model in `bench=skip`: on the whole grid, a cropped one, a visual hull."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from mvrecon.models.networks import MULTIPLE
from torch import Tensor

from mvrecon.engine.checkpoints import load
from mvrecon.geometry.box import Box, placed
from mvrecon.geometry.grid import Grid
from mvrecon.metrics import volume_metrics
from mvrecon.parts import MODELS, PROJECTORS
from mvrecon.projectors.operator import Projector
from mvrecon.visual_hull.support import Support, support_from_views
from mvrecon_bench.benchmarks.skip_scenes import Seen, cube, edge, rig, seen
from mvrecon_bench.benchmarks.skip_tasks import CROPPED, DENSE, Trial

#: Voxels left around the object where a user crops: as many as the model leaves by default.
HALO = 4
#: The model's own time: what it keeps of a crop's geometry is made anew at every call, as for ever
#: new scenes, or kept.
CHANGING, STATIC = "cross_view", "cross_view_static"


@dataclass(frozen=True, eq=False)
class Learned:
    """A model on a scene.

    Args:
        scene: configuration, see `skip_scenes.filled`.
        projector: name and options.
        A: the projector on the whole grid.
        model: name and options.
        weights: of the model; None: the same random ones in every mode.
        data_range: for PSNR.
        cases: over how many PSNR is averaged.
        device: where all of it is.
    """

    scene: Mapping[str, Any]
    projector: Mapping[str, Any]
    A: Projector
    model: Mapping[str, Any]
    weights: Mapping[str, Tensor] | None
    data_range: float
    cases: int
    device: str

    @classmethod
    def of(
        cls,
        scene: Mapping[str, Any],
        settings: Mapping[str, Any],
        checkpoint: str | None,
        device: str,
    ) -> "Learned":
        """A trained model with the grid and rig of its checkpoint, or a fresh one as the settings
        have it.

        Raises:
            FileNotFoundError: no such checkpoint.
        """
        if checkpoint is not None:
            module = load(Path(checkpoint)).module
            known = module.hparams
            A, model, projector = module.projector, known["model"], known["geometry"]["projector"]
            weights, data_range = dict(module.model.named_parameters()), known["data_range"]
            return cls(
                scene,
                projector,
                A.to(device),
                model,
                weights,
                data_range,
                settings["cases"],
                device,
            )
        grid = cube(scene, settings["n"])
        cameras = rig(settings["rig"], edge(grid), settings["n"])
        projector = {"name": "radon" if cameras.parallel else "drr"}
        A = PROJECTORS.from_config(projector, grid=grid, cameras=cameras).to(device)
        return cls(scene, projector, A, settings["model"], None, 1.0, settings["cases"], device)

    @cached_property
    def first(self) -> Seen:
        """The case that is timed."""
        return seen(self.scene, self.A)

    def trial(self, task: str, mode: str) -> Trial:
        """The model in a mode: "off", "cropped", or a kind of support."""
        box = (
            Box.around(self.first.inside)
            .grown(HALO, self.A.grid.shape)
            .aligned(MULTIPLE, self.A.grid.shape)
        )
        box = box if mode == CROPPED else Box.whole(self.A.grid.shape)
        net = self.net("none" if mode in DENSE else mode, self.A.grid.cropped(box))
        views = self.first.views.to(self.device)

        def call() -> Tensor:
            if task == CHANGING:
                net.cropping.crops.clear()
            return net(views).volume

        def score() -> float:
            return sum(self.psnr(net, box, index) for index in range(self.cases)) / self.cases

        return Trial(
            call=call,
            whole=lambda part: placed(part, box, self.A.grid.shape),
            choice=lambda: ("none", "") if mode in DENSE else _choice(self.support(mode)),
            build=None if mode in DENSE else lambda: self.support(mode),
            score=None if self.weights is None else score,
        )

    def support(self, kind: str) -> Support:
        """The support that the views of the first case tell."""
        return support_from_views(
            self.first.views.to(self.device), self.A.cameras, self.A.grid, kind=kind
        )

    def net(self, support: str, grid: Grid) -> Any:
        """The model on a grid with a kind of support, its weights the same in all modes."""
        A = PROJECTORS.from_config(self.projector, grid=grid, cameras=self.A.cameras).to(
            self.device
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            net = MODELS.from_config({**self.model, "support": support}, projector=A)
        if self.weights is not None:
            for name, weight in net.named_parameters():
                weight.data.copy_(self.weights[name])
        return net.to(self.device).eval()

    def psnr(self, net: Any, box: Box, index: int) -> float:
        """Of one case in dB, over the whole grid."""
        case = seen(self.scene, self.A, index)
        volume = placed(net(case.views.to(self.device)).volume, box, self.A.grid.shape)[0].cpu()
        return volume_metrics(volume, case.volume, case.inside, self.data_range)["psnr"]


def _choice(support: Support) -> tuple[str, str]:
    return support.kind, f"{support.fraction:.1%} of the grid"
