"""One model on several rigs: the same weights, another geometry."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.cameras.field import common_field
from mvrecon.models.output import Reconstruction
from mvrecon.parts import MODELS, PROJECTORS
from mvrecon.projectors.operator import Projector


@dataclass(eq=False)
class OnRig:
    """A model on one rig.

    Args:
        A: operator of the rig.
        model: for it.
        projector: name and options of the operator.
        options: name and options of the model.
    """

    A: Projector
    model: nn.Module
    projector: dict[str, Any]
    options: dict[str, Any]

    @cached_property
    def corrected(self) -> Projector:
        """The operator of the views that the model corrects: its own, or one for the model's
        `corrected_cameras`, of the same kind unless the model has a `corrected_projector`.
        """
        cameras = getattr(self.model, "corrected_cameras", None)
        if cameras is None:
            return self.A
        config = getattr(self.model, "corrected_projector", self.projector)
        A = PROJECTORS.from_config(config, grid=self.A.grid, cameras=cameras)
        return A.to(self.A.device)

    @cached_property
    def common_field(self) -> Bool[Tensor, "1 d h w"]:
        """The voxels that all cameras see."""
        return common_field(self.A.cameras, self.A.grid)

    def by(self, name: str, views: Float[Tensor, "b 1 m v u"]) -> Reconstruction:
        """What a model without training makes of views."""
        return MODELS.build(name, projector=self.A).to(views.device)(views)

    def ready(self, device: torch.device, training: bool) -> "OnRig":
        """The same on a device, for training or not."""
        self.A.to(device)
        self.model.to(device).train(training)
        return self


def model_on(A: Projector, module: nn.Module, source: str) -> nn.Module:
    """The model of a trained module with its weights on another operator, ready to reconstruct.

    Args:
        A: the operator, of any rig and grid that the model's weights fit.
        module: as `load` gives it.
        source: where it came from, for the message.

    Raises:
        ValueError: weights that fit the rig and the grid of the training alone.
    """
    try:
        model = with_weights_of(module.model, module.hparams["model"], A)  # type: ignore[arg-type, index]
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    return model.to(A.device).eval()


def with_weights_of(model: nn.Module, options: dict[str, Any], A: Projector) -> nn.Module:
    """A model of the same options for another operator, whose weights are the very tensors of the
    first: what one learns, both have learned.

    Args:
        model: that has the weights.
        options: its name and options.
        A: the other operator.

    Raises:
        ValueError: weights that belong to a rig or a grid, such as a network for each camera.
    """
    with torch.random.fork_rng(devices=[]):  # initial weights that nobody uses
        other = MODELS.from_config(options, projector=A)
    weights = model.state_dict(keep_vars=True)
    if differing := differences(weights, other.state_dict()):
        raise ValueError(
            f"Expected weights that fit any rig, got {len(differing)} of {options['name']!r} that "
            f"do not fit {len(A.cameras)} cameras of {tuple(A.cameras.shape)} pixels and "
            f"{A.grid.shape} voxels, {differing[0]} among them; networks of cameras need shared: "
            f"true"
        )
    for name, tensor in weights.items():
        owner, _, last = name.rpartition(".")
        setattr(other.get_submodule(owner), last, tensor)
    return other


def differences(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> list[str]:
    """Names of the weights that only one of two models has, or whose shapes differ."""
    return [
        name
        for name in {**one, **other}
        if name not in one or name not in other or one[name].shape != other[name].shape
    ]
