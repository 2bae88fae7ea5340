"""Arms of the study: the phantoms, the rig, and what differs between the networks."""

WELLS, RADIUS, HEIGHT = (16, 14, 12, 10, 8, 6), 60.0, 72.0
BASE = (
    "projector=spect",
    "camera=dcspect80",
    "camera.pixels=32",
    "camera.columns=[1,6,11,16]",  # of each of the four rows: 16 pinholes
    "grid.spacing=5.0",
    "scene=derenzo",
    f"scene.well_diameters={list(WELLS)}",
    f"scene.radius_mm={RADIUS}",
    f"scene.height_mm={HEIGHT}",
    "scene.fill=null",
    "acquisition=counts",
    "acquisition.closed_form=false",
    "callbacks=quiet",
    "logger=csv",
)
SUBSETS = 4  # the root of the number of cameras, with which networks start, too
START = "model.start={name: osem, iterations: 5, background: 1e-3}"
EM = "model.consistency={steps: 3, noise: poisson, rule: em, background: 1e-3}"
NARROW = "model.rounds=[{resolution: full, widths: [16,32,64], cameras: null}]"
RADON = ("model=radon_unet", "model.angles=128", START)
MEAN = ("model=mean_fusion", "model.opinion.binning=4", START, EM)

#: What differs between the networks.
ARMS = {
    "radon_unet": (*RADON, "loss.volume=0"),
    "radon_unet_end": (*RADON, "loss.corrected_views=0"),
    "world_unet": ("model=world_unet_counts", NARROW),
    "world_unet_squares": ("model=world_unet", NARROW),
    "mean_fusion": MEAN,
    "mean_fusion_own": (*MEAN, "model.opinion.shared=false"),
    "cross_view": ("model=cross_view_counts",),
    "cross_view_density": (
        "model=cross_view_counts",
        "model.rounds.0.opinions.head.name=density",
    ),
    "mean_fusion_density": (*MEAN, "head@model.head=density"),
}
ABLATIONS = ("mean_fusion_own", "cross_view_density", "mean_fusion_density")
MAIN = tuple(name for name in ARMS if name not in ABLATIONS)
