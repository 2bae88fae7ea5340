# %% [markdown]
# # A cone-beam scan to a NIfTI volume
#
# A scan consists of a folder of images and a geometry file. This page first simulates both, with TIGRE's JSON: exact line integrals
# through ellipsoids, not projections of the voxels that are reconstructed. The steps from *Read the scan* on are those for real files.

# %%
import json
import math

import mvrecon as mv
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.data.projections.writing import Exposure, write_projections
from mvrecon.geometry.cameras.field import check_rig_sees
from mvrecon.geometry.cameras.formats import tigre
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png
from mvrecon.report.viz.rig import save_picture

geometry = {
    "DSD": 600.0,  # mm, source to detector
    "DSO": 400.0,  # mm, source to axis
    "nDetector": [48, 64],  # (v, u)
    "dDetector": [3.0, 3.0],  # mm
    "angles": [2 * math.pi * n / 60 for n in range(60)],  # radians, as TIGRE stores them
}
with open("geometry.json", "w") as file:
    json.dump(geometry, file)

scan = mv.phantom(
    "ellipsoids",
    mv.Grid.centred(size=(40, 40, 32), spacing=2.5),
    tigre.read("geometry.json"),
    value=0.02,  # 1/mm, the attenuation of water
)
patient = scan.volume[0]  # [d h w]
write_projections(
    "scan", scan.views[0].flip(-2), Exposure(photons=2e4, seed=1)
)  # 16-bit TIFF, dark and flat fields

# %% [markdown]
# ## Read the scan
#
# Draw the geometry first: a wrong sign is obvious in a picture. Each format defines whether the rows of stored views run upwards; TIGRE's
# do, so they are flipped.

# %%
cameras = tigre.read("geometry.json")
grid = mv.Grid.centred(size=(40, 40, 32), spacing=2.5)
assert check_rig_sees(cameras, grid).all()
save_picture("rig.png", cameras, grid)

# %%
views = (
    MeasuredViews(Measured(path="scan")).whole().views.flip(-2)
)  # [m v u], -ln((I - D) / (F - D))
print(f"{len(views)} views, line integrals up to {views.max():.2f}")
save_png("views.png", review.mosaic(views[:4], "patient", "1/mm * mm"))

# %% [markdown]
# ## Reconstruct it
#
# `fdk` is the usual first look at many views, `fista_tv` reconstructs from few; `mvrecon-list method` lists all methods. The residual shows
# whether geometry and views agree: with a wrong sign it is several times as large.

# %%
volume = mv.reconstruct(views[None, None], cameras, grid, method="fdk")
residual = mv.Drr(grid, cameras)(volume)[0, 0] - views
print(f"relative residual of the views: {residual.norm() / views.norm():.1%}")
assert residual.norm() < 0.1 * views.norm()

mv.save_volume("volume.nii.gz", volume[0, 0], grid)  # opens in any viewer, at the patient's place
again, _ = mv.read_volume("volume.nii.gz")
assert (again - volume[0, 0]).abs().max() < 1e-6

# %% [markdown]
# ## With a sixth of the dose
#
# Ten of the sixty views: FDK has streaks, total variation does not.

# %%
few, rig = views[None, None, ::6], cameras[::6]
results = {
    "FDK, 60 views": volume,
    "FDK, 10 views": mv.reconstruct(few, rig, grid, method="fdk"),
    "TV, 10 views": mv.reconstruct(few, rig, grid, method="fista_tv", iterations=60, weight=3e-5),
}
errors = {name: float((x[0, 0] - patient).norm() / patient.norm()) for name, x in results.items()}
print("\n".join(f"{name}: relative error {error:.0%}" for name, error in errors.items()))
assert errors["TV, 10 views"] < 0.7 * errors["FDK, 10 views"]
case = review.CaseSheets("patient", grid, float(patient.max()), "1/mm")
shown = {f"{name}\nerror {errors[name]:.0%}": x[0, 0] for name, x in results.items()}
save_png("planes.png", review.planes(case, patient, shown))

# %% [markdown]
# The same in one command, which also chooses the grid:
#
# ```bash
# mvrecon-reconstruct views.path=scan camera=tigre camera.path=geometry.json out=volume.nii.gz
# ```
#
# DICOM series, flat fields, detector offsets and calibration: [scan.md](../scan.md), [data.md](../data.md),
# [geometry_files.md](../geometry_files.md).
