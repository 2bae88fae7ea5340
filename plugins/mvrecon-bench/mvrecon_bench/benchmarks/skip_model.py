"""The cross-view model in `bench=skip`: on the whole grid, a cropped one, a visual hull."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.grid import Box, placed
from mvrecon.methods.learned.cross_view import BOX_MULTIPLE
from mvrecon.methods.method import build_method
from mvrecon.operators.operator import Projector
from mvrecon.operators.visual_hull.support import Support, support_from_views
from mvrecon.report.metrics import volume_metrics
from mvrecon.training.trained import load
from mvrecon_bench.benchmarks.skip_scenes import Seen, cube, edge, rig, seen
from mvrecon_bench.benchmarks.skip_tasks import CROPPED, DENSE, SkipTrial

#: Margin of voxels around the object for manual cropping, equal to the model's.
HALO = 4
#: Its task.
CROSS_VIEW = "cross_view"


@dataclass(frozen=True, eq=False)
class Learned:
    """A method on a scene.

    Args:
        scene: configuration, see `skip_scenes.filled`.
        projector: name and options.
        A: the projector on the whole grid.
        method: name and options.
        weights: weights of the method; None: the same random weights in every mode.
        data_range: data range of the PSNR.
        cases: number of cases over which the PSNR is averaged.
        device: device of all tensors.
    """

    scene: Mapping[str, Any]
    projector: Mapping[str, Any]
    A: Projector
    method: Mapping[str, Any]
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
        """A trained method with the grid and rig of its checkpoint, or an untrained one according
        to the settings.

        Raises:
            FileNotFoundError: the checkpoint does not exist.
        """
        cases = settings["cases"]
        if checkpoint is not None:
            module = load(Path(checkpoint)).module
            known, A = module.hparams, module.projector.to(device)
            method, projector = known["method"], known["geometry"]["projector"]
            weights, data_range = module.method.state_dict(), known["data_range"]
            return cls(scene, projector, A, method, weights, data_range, cases, device)
        grid = cube(scene, settings["n"])
        cameras = rig(settings["rig"], edge(grid), settings["n"])
        projector = {"name": "radon" if cameras.parallel else "drr"}
        A = PROJECTORS.from_config(projector, grid=grid, cameras=cameras).to(device)
        return cls(scene, projector, A, settings["method"], None, 1.0, cases, device)

    @cached_property
    def first(self) -> Seen:
        """The timed case."""
        return seen(self.scene, self.A)

    def trial(self, mode: str) -> SkipTrial:
        """The method in a mode: "off", "cropped", or a kind of support."""
        whole = Box.whole(self.A.grid.shape)
        box = (
            Box.around(self.first.inside)
            .grown(HALO, whole.shape)
            .aligned(BOX_MULTIPLE, whole.shape)
        )
        box = box if mode == CROPPED else whole
        net, A = self.net("none" if mode in DENSE else mode), self.A.cropped(box)
        views = self.first.views.to(self.device)

        def score() -> float:
            return sum(self.psnr(net, A, box, index) for index in range(self.cases)) / self.cases

        return SkipTrial(
            call=lambda: net(views, A).volume,
            whole=lambda part: placed(part, box, whole.shape),
            choice=lambda: ("none", "") if mode in DENSE else _choice(self.support(mode)),
            build=None if mode in DENSE else lambda: self.support(mode),
            score=None if self.weights is None else score,
        )

    def support(self, kind: str) -> Support:
        """The support from the views of the first case."""
        return support_from_views(
            self.first.views.to(self.device), self.A.cameras, self.A.grid, kind=kind
        )

    def net(self, support: str) -> nn.Module:
        """The method with a kind of support, cropped to it, with the same weights in all modes."""
        options = {"support": support, "crop": support != "none"}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            net = build_method({**self.method, **options})
        if self.weights is not None:
            net.load_state_dict(self.weights)
        return net.to(self.device).eval()

    def psnr(self, net: nn.Module, A: Projector, box: Box, index: int) -> float:
        """PSNR of one case in dB, over the entire grid."""
        case = seen(self.scene, self.A, index)
        part = net(case.views.to(self.device), A).volume
        volume = placed(part, box, self.A.grid.shape)[0].cpu()
        return volume_metrics(volume, case.volume, case.inside, self.data_range)["psnr"]


def _choice(support: Support) -> tuple[str, str]:
    return support.kind, f"{support.fraction:.1%} of the grid"
