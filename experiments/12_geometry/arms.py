"""Arms and regimes of the study: what differs between the models, and between their views."""

from pathlib import Path
from typing import NamedTuple

BASE = (
    "experiment=open_kbp_cross_view",
    "~compare.world_rounds",
    "~compare.world_unet",
    "scene.vary=exact",
    "data.sizes.train=648",
    "callbacks=quiet",
    "logger=csv",
)
NARROW = "rounds=[{resolution: full, widths: [16,32,64], cameras: null}]"
HALF = "{resolution: half, widths: [32,48,64]"
CAMERAS = "cameras: {name: rays2d}"
FULL = f"{{resolution: full, widths: [16,32,64], {CAMERAS}}}"
ONE = f"rounds=[{FULL}]"
QUARTER = f"{{resolution: quarter, widths: [8], {CAMERAS}"

#: What differs between the models.
ARMS = {
    "cross_view": ("model=cross_view",),
    "wide_cells": ("model=cross_view", "model.rounds.0.cameras.binning=9"),
    "equal_rays": ("model=cross_view", "model.rounds.0.opinions.weigh_rays=false"),
    "one_round": ("model=cross_view", f"model.{ONE}"),
    "two_rounds": ("model=cross_view", f"model.rounds=[{QUARTER}, opinions: {{}}}}, {FULL}]"),
    "no_opinions": ("model=cross_view", f"model.rounds=[{QUARTER}}}, {FULL}]"),
    "three_rounds": (
        "model=cross_view",
        f"model.rounds=[{HALF}, {CAMERAS}}}, {HALF}}}, {{resolution: full, widths: [16,32,64]}}]",
    ),
    "world_rounds": ("model=world_rounds",),
    "world_unet": ("model=world_unet", f"model.{NARROW}"),
}
#: `cross_view` but for one option; these take its number of steps.
ABLATIONS = {
    name: ("model=cross_view", f"model.rounds.0.{option}")
    for name, option in {
        "uncorrected": "cameras.correct=false",
        "own_networks": "cameras.shared=false",
        "mean_of_opinions": "opinions.fusion=mean",
        "view_placed": "opinions.places=view",
        "density_head": "opinions.head.name=density",
        "uniform_depths": "opinions.prior=uniform",
    }.items()
}
ABLATIONS["frustum3d"] = ("model=cross_view_frustum3d",)
#: Models that know less of the cameras, or are published; in the whole grid.
OTHERS = {name: (f"model={name}",) for name in ("geometry_free", "dif_net", "svct")}
#: These begin with SIRT on a grid twice as fine, which is made once a case and not in the pace.
FINER = {
    f"{arm}_finer": (*ARMS[arm], "model.start={name: finer}")
    for arm in ("cross_view", "one_round", "world_unet")
}
#: The same, and what the coarse grid misses is taken off the views.
MISSED = {
    f"{arm}_missed": (
        *ARMS[arm],
        "model.start={name: sirt, iterations: 25, momentum: true, finer_grid: 2}",
    )
    for arm in ("cross_view", "one_round", "world_unet")
}
ALIGNED = {
    "cross_view_aligned": ("model=corrected", "model@model.model=cross_view"),
    "one_round_aligned": (
        "model=corrected",
        "model@model.model=cross_view",
        f"model.model.{ONE}",
    ),
    "world_unet_aligned": (
        "model=corrected",
        "model@model.model=world_unet",
        f"model.model.{NARROW}",
    ),
}
CLASSICAL = {
    "sirt": ("model=sirt", "model.iterations=25"),
    "sirt_aligned": ("model=corrected", "model@model.model=sirt", "model.model.iterations=25"),
    "tv": (
        "model=classical",
        "reconstructor@model.reconstructor=fista_tv",
        "model.reconstructor.weight=1e-4",
    ),
    "tv_aligned": (
        "model=corrected",
        "model@model.model=classical",
        "reconstructor@model.model.reconstructor=fista_tv",
        "model.model.reconstructor.weight=1e-4",
    ),
}


EVERY = ARMS | ABLATIONS | OTHERS | FINER | MISSED | ALIGNED | CLASSICAL


class Regime(NamedTuple):
    """What differs between the views of the regimes.

    Args:
        views: overrides of rig and acquisition.
        support: that the networks work in; a hull of views that err can cut into the object.
        pace: the regime whose training steps take as long.
        options: of every network.
        begins: the run of the same arm whose weights training begins with, at half its greatest
            learning rate; none for random weights.
    """

    views: tuple[str, ...] = ()
    support: str = "hull"
    pace: str = "clean"
    options: tuple[str, ...] = ()
    begins: str = ""

    def start(self, runs: Path, arm: str, seed: int) -> list[str]:
        """The overrides that say where training begins."""
        if not self.begins:
            return []
        return [f"init_from={runs / self.begins.format(arm=arm, seed=seed)}", "optimizer.lr=1e-3"]


def _disturbed(options: str) -> Regime:
    return Regime((f"acquisition={{disturbed: {{{options}}}}}",), "none", "rig")


def _fine(regime: Regime, size: int, name: str) -> Regime:
    """A regime on the patients' own grid: `size` voxels an edge, networks in the box of the hull.
    Three of the four views that must agree on an empty brick may be wrong.
    """
    part, pixels = 32 / size, 3 * size // 2
    spacing = [16 * part, 10 * part, 12 * part]
    return Regime(
        (
            *regime.views,
            f"grid={{size: [{size},{size},{size}], spacing: {spacing}}}",
            f"camera.detector={{pixels: {pixels}, pixel_mm: [{18 * part},{20 * part}]}}",
            "data.batch_size=1",
        ),
        "hull",
        name,
        ("crop=true", *(() if regime.support == "hull" else ("noise={witnesses: 4}",))),
    )


def _tuned(regime: Regime, begins: str, cases: int) -> Regime:
    """A regime whose training begins with the weights of another, on so many cases."""
    return regime._replace(begins=begins, views=(*regime.views, f"data.sizes.train={cases}"))


RIG = _disturbed("views: 3, shift_px: 1.0, gain: 0.05")
REGIMES = {
    "clean": Regime(),
    "photons_1e4": Regime(("acquisition=photons", "acquisition.photons=1e4")),
    "photons_1e3": Regime(("acquisition=photons", "acquisition.photons=1e3"), "none", "rig"),
    "rig": RIG,
    "rig_cases": RIG._replace(views=(*RIG.views, "data.sizes.train=2592")),
    "rig_one": _disturbed("views: 1, shift_px: 1.0, gain: 0.05"),
    "rig_all": _disturbed("views: 8, shift_px: 1.0, gain: 0.05"),
    "tilt": _disturbed("views: 3, tilt_deg: 5.0"),
    "motion": _disturbed("views: 3, motion_mm: 15.0"),
    "lost": _disturbed("views: 1, lost: 1"),
    "saturated": _disturbed("views: 3, saturated: 0.2"),
    "truncated": _disturbed("views: 1, truncated: 0.25"),
    "views_2": Regime(("camera.n_views=2",), pace="views_2"),
    "views_3": Regime(("camera.n_views=3",), pace="views_3"),
    "views_4": Regime(("camera.n_views=4",), pace="views_4"),
    "views_16": Regime(("camera.n_views=16",), pace="views_16"),
    "pixels_half": Regime(
        ("camera.detector.pixels=[96,96]", "camera.detector.pixel_mm=[9.0,10.0]"),
        pace="pixels_half",
    ),
    "pixels_third": Regime(
        ("camera.detector.pixels=[144,144]", "camera.detector.pixel_mm=[6.0,6.6667]"),
        pace="pixels_third",
    ),
    "clean_64": _fine(Regime(), 64, "clean_64"),
    "rig_64": _fine(RIG, 64, "rig_64"),
    "rig_64_tuned": _fine(RIG, 64, "rig_64")._replace(begins="rig_cases/{arm}/1600s_{seed}"),
    "clean_128": _fine(Regime(), 128, "clean_128"),
    "rig_128": _fine(RIG, 128, "rig_128"),
}
#: From 32^3 over 64^3 to 128^3, with fewer cases, since one at 128^3 takes 5 s to make.
REGIMES["rig_64_on_the_way"] = _tuned(REGIMES["rig_64"], "rig/{arm}/400s_{seed}", 324)
REGIMES["rig_128_tuned"] = _tuned(REGIMES["rig_128"], "rig_64_on_the_way/{arm}/400s_{seed}", 162)
REGIMES["rig_64_longer"] = _tuned(REGIMES["rig_64"], "rig_64_on_the_way/{arm}/400s_{seed}", 324)
REGIMES["rig_128_longer"] = _tuned(REGIMES["rig_128"], "rig_64_longer/{arm}/800s_{seed}", 162)
#: Networks and sizes as of rig_64.
REGIMES["clean_64_on_the_way"] = _tuned(
    REGIMES["clean_64"]._replace(pace="rig_64"), "clean/{arm}/200s_{seed}", 324
)
REGIMES["clean_128_tuned"] = _tuned(
    REGIMES["clean_128"]._replace(pace="rig_128"), "clean_64_on_the_way/{arm}/400s_{seed}", 162
)


def settings(regime: Regime, arm: str) -> list[str]:
    """The overrides of an arm in a regime."""
    options = [*BASE, *EVERY[arm], *regime.views]
    if (
        arm in OTHERS | ALIGNED | CLASSICAL
    ):  # options of the experiment's own model, which these have not
        options += ["~model.support", "~model.precision"]
    if arm in OTHERS | CLASSICAL:
        return options
    inside = "model.model" if arm in ALIGNED else "model"
    network = (f"support={regime.support}", "precision=auto", *regime.options)
    return [*options, *(f"{inside}.{option}" for option in network)]


def paths(data: Path) -> list[str]:
    """The overrides that say where the patients lie."""
    files = ("scene.path", "openkbp_train.h5"), ("test_scene.path", "openkbp_val.h5")
    return [f"{key}={data / name}" for key, name in files]
