"""What every model returns."""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from mvrecon.calibration.alignment import Alignment
from mvrecon.reconstructors.division import divided


@dataclass
class Reconstruction:
    """A reconstructed volume, and how it came about where the model can tell.

    Args:
        volume: in the unit of (views / mm).
        opinions: each camera's own volume; like `visible` and `weights` in cells of 2 x 2 x 2 or
            4 x 4 x 4 voxels where they have half or a quarter of the resolution.
        visible: which voxels each camera's frustum holds.
        weights: how much each camera counts at each voxel; they sum to one over the cameras that
            see it.
        cross_views: opinion m projected into camera n, in the unit of the views; of a model in
            rounds what the opinions of all others together predict for camera n, m = 1, in cells of
            pixels.
        sigma: standard deviation of the error that the model expects of each voxel of the volume.
        support: where the volume may differ from zero; none for everywhere.
        start: the classical reconstruction that the network began with.
        start_views: the start projected into every camera, in the unit of the views.
        earlier: the volumes after each round but the last, of a model in rounds.
        entry: the volume that enters expectation maximisation, which hides its scale and what is
            negative.
        corrected_views: the views as the cameras' networks of each round have corrected them, or
            the completed sinogram, in the unit of the views. They are of the model's
            `corrected_cameras`, if it has them, else of its rig.
        row: R, the inverse row sums of A, or of one typical chord, in 1/mm, where views are
            corrected.
        alignment: what was wrong with each camera, where views were aligned before.
    """

    volume: Float[Tensor, "b 1 d h w"]
    opinions: Float[Tensor, "b m 1 d h w"] | None = None
    visible: Bool[Tensor, "m 1 d h w"] | None = None
    weights: Float[Tensor, "b m 1 d h w"] | None = None
    cross_views: Float[Tensor, "b m n v u"] | None = None
    sigma: Float[Tensor, "b 1 d h w"] | None = None
    support: Bool[Tensor, "b 1 d h w"] | None = None
    start: Float[Tensor, "b 1 d h w"] | None = None
    start_views: Float[Tensor, "b 1 m v u"] | None = None
    earlier: tuple[Float[Tensor, "b 1 d h w"], ...] = ()
    entry: Float[Tensor, "b 1 d h w"] | None = None
    corrected_views: tuple[Float[Tensor, "b 1 n v u"], ...] = ()
    row: Float[Tensor, "#b 1 #n #v #u"] | None = None
    alignment: Alignment | None = None

    def split(self) -> list[Self]:
        """The reconstruction of each case of the batch."""
        count = len(self.volume)

        def case(value: Any, i: int) -> Any:
            if isinstance(value, tuple):
                return tuple(case(one, i) for one in value)
            if isinstance(value, Alignment):
                return value.split()[i]
            return value[i : i + 1] if value is not None and len(value) == count else value

        own = [field.name for field in fields(self) if field.name != "visible"]  # of all cases
        return [
            replace(self, **{name: case(getattr(self, name), i) for name in own})
            for i in range(count)
        ]

    @property
    def camera_weights(self) -> Float[Tensor, "b m"] | None:
        """How much each camera counts over the object, without a unit: the mean of its weights, in
        which a voxel counts by its density; they sum to one. None where cameras are not weighed.
        """
        if self.weights is None:
            return None
        d, h, w = self.weights.shape[-3:]
        density = adaptive_avg_pool3d(self.volume.clamp_min(0), (d, h, w))
        sums = (self.weights * density[:, None]).flatten(2).sum(dim=2)
        return divided(sums, sums.sum(dim=1, keepdim=True))
