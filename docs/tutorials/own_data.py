# %% [markdown]
# # Your own data
#
# A scanner leaves a folder of images and a file of its geometry. Here both are made first: a CT volume in a NIfTI file stands
# for the patient, TIGRE's JSON for the scanner. From "Reading" on, the steps are those for real files.

# %%
import json
import math

import mvrecon as mv
from mvrecon.core.parts import SCENES
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.data.projections.writing import Exposure, write_projections
from mvrecon.geometry.cameras.field import check_rig_sees
from mvrecon.geometry.cameras.formats import tigre
from mvrecon.report.viz import review
from mvrecon.report.viz.rig import save_picture
from mvrecon.training.export import save_png

geometry = {
    "DSD": 600.0,  # mm, source to detector
    "DSO": 400.0,  # mm, source to axis
    "nDetector": [48, 64],  # (v, u)
    "dDetector": [3.0, 3.0],  # mm
    "angles": [2 * math.pi * n / 60 for n in range(60)],  # TIGRE has radians
}
with open("geometry.json", "w") as file:
    json.dump(geometry, file)

box = mv.Grid.centred(size=(40, 40, 32), spacing=2.5)
scanner = tigre.read("geometry.json")
phantom = SCENES.build("shepp_logan", value=0.02)  # 1/mm, as water
mv.save_volume("patient.nii.gz", phantom.sample(0, 0, box, scanner).volume[0], box)

patient, world = mv.read_volume("patient.nii.gz")  # [d h w], and where it lies
integrals = mv.Drr(world, scanner)(patient[None, None])[0, 0]
write_projections(
    "scan", integrals.flip(-2), Exposure(photons=1e5, seed=1)
)  # rows upwards, as TIGRE

# %% [markdown]
# ## Reading
#
# The geometry first: a picture shows a wrong sign at once. Every format says whether the rows of stored views run upwards;
# TIGRE's do, so they are reversed.

# %%
cameras = tigre.read("geometry.json")
grid = mv.Grid.centred(size=(40, 40, 32), spacing=2.5)
assert check_rig_sees(cameras, grid).all()
save_picture("rig.png", cameras, grid)

views = (
    MeasuredViews(Measured(path="scan")).whole().views.flip(-2)
)  # [m v u], line integrals: -ln((I - D) / (F - D))
print(f"{len(views)} views, line integrals up to {views.max():.2f}")
save_png("views.png", review.mosaic(views[:4]))

# %% [markdown]
# ## Reconstructing
#
# `fdk` is the usual first look, `fista_tv` for few views; `mvrecon-list method` shows all.

# %%
volume = mv.reconstruct(views[None, None], cameras, grid, method="fdk")
few = mv.reconstruct(views[None, None, ::6], cameras[::6], grid, method="fista_tv", iterations=40)
residual = mv.Drr(grid, cameras)(volume)[0, 0] - views
print(f"view NRMSE of fdk: {residual.norm() / views.norm():.2%}")
assert residual.norm() < 0.1 * views.norm()  # with a wrong sign it is several times as much
shown = {"FDK": volume[0, 0], "TV, 10 views": few[0, 0]}
save_png("planes.png", review.planes(review.Case("patient", grid, 0.03, "1/mm"), patient, shown))
mv.save_volume("volume.nii.gz", volume[0, 0], grid)  # opens in any viewer, where the patient is

# %% [markdown]
# In one command, which also picks the grid:
#
# ```bash
# mvrecon-reconstruct views.path=scan camera=tigre camera.path=geometry.json out=volume.nii.gz
# ```
#
# A DICOM series instead of the TIFF folder, dark and flat fields, offsets, calibration: [scan.md](../scan.md),
# [data.md](../data.md), [geometry_files.md](../geometry_files.md).
