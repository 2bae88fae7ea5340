"""Check that a run's projector gives the views that its scenes measure."""

import warnings

import torch

from mvrecon.data.module import SceneData
from mvrecon.engine.module import Settings, build_projector

#: The share by which the sum of the truth's projections may miss that of the views. The grid alone
#: makes up to a tenth.
ALLOWED = 0.25


@torch.inference_mode()
def warn_of_other_views(settings: Settings, data: SceneData) -> None:
    """Warn if the projections of the first test case's truth and its views have different sums.

    Scenes measure line integrals, so the sums reveal a projector of counts, of attenuated rays or
    of another unit; they do not reveal one that only blurs.
    """
    data.setup("test")
    cases = data.sets["test"].prepare()
    if not cases["name"]:
        return
    projector = settings["projector"]
    A = build_projector(settings["grid"], settings["camera"], projector)
    views, projections = cases["views"][:1], A(cases["volume"][:1])
    share = float(
        projections.abs().sum() / views.abs().sum().clamp(min=torch.finfo(views.dtype).tiny)
    )
    if views.any() and abs(share - 1) > ALLOWED:
        warnings.warn(
            f"The scene's views are not what projector={projector['name']} makes: its projections "
            f"of the truth of "
            f"{cases['name'][0]} add up to {share:.3g} of what the scene measures, expected 1. "
            f"Scenes measure line "
            "integrals (drr, radon); errors of views and every reconstruction suffer from this",
            RuntimeWarning,
            stacklevel=2,
        )
