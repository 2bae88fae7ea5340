# %% [markdown]
# # Pinhole SPECT
#
# Gamma quanta from the patient pass 80 pinholes, each with its own detector. The plugin `mvrecon-spect` models their sensitivity,
# blur and attenuation, and reconstructs activity from counts: `pip install plugins/mvrecon-spect`.

# %%
import torch

import mvrecon as mv
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png
from mvrecon.report.viz.rig import save_picture
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.operators.projector import Spect

grid = mv.Grid.centred(32, spacing=5.0)  # mm
cameras = mv.dcspect80(pixels=[32, 32])  # 80 pinholes that aim at the heart
save_picture("rig.png", cameras, grid)

# %% [markdown]
# ## Activity to counts
#
# A Derenzo phantom with rods of 20 to 8 mm, seen in 4e6 counts. With `blur=True` every point is imaged as the disc of its 2.3 mm
# pinhole. The counts follow the operator that reconstructs them: errors are smaller than those of measured counts.

# %%
rods = (20, 17, 14, 12, 10, 8)  # mm
size = {"radius_mm": 62.0, "height_mm": 70.0, "well_diameters": rods}
phantom = mv.phantom("derenzo", grid, cameras[:1], seed=4, fill=None, **size)
truth = phantom.volume[None]  # activity, [1 1 d h w]
A = Spect(grid, cameras, diameter_mm=2.3, blur=True)
truth *= 4e6 / A(truth).sum()
torch.manual_seed(0)
counts = torch.poisson(A(truth))  # [1 1 m v u]
empty = (counts == 0).float().mean()
print(
    f"{counts.sum():.0f} counts, at most {counts.max():.0f} in a pixel; {empty:.0%} of the pixels are empty"
)
save_png("views.png", review.mosaic(counts[0, 0], unit="counts"))

# %% [markdown]
# ## Counts to activity
#
# OSEM maximises the Poisson likelihood. Without the blur in its operator it returns a blurred volume; with it, the small rods appear.
# BSREM adds a relative difference prior, which limits the noise.

# %%
no_blur = Spect(grid, cameras, diameter_mm=2.3)
results = {
    "OSEM, no blur": mv.osem(no_blur, counts, iterations=8, subsets=8),
    "OSEM": mv.osem(A, counts, iterations=10, subsets=16),
    "BSREM": bsrem(A, counts, iterations=12, weight=0.001),
}
errors = {name: float((x - truth).norm() / truth.norm()) for name, x in results.items()}
print("\n".join(f"{name}: relative error {error:.0%}" for name, error in errors.items()))
assert errors["OSEM"] < 0.8 * errors["OSEM, no blur"]

case = review.CaseSheets("Derenzo phantom, 80 pinholes", grid, float(truth.max()), "counts/mm^3")
shown = {f"{name}\nerror {errors[name]:.0%}": x[0, 0] for name, x in results.items()}
save_png("planes.png", review.planes(case, truth[0, 0], shown))

# %% [markdown]
# Attenuation by the patient (`mu`) and penetration of the pinholes' edges: [spect_model.md](../spect_model.md). Scatter:
# [spect_corrections.md](../spect_corrections.md). Data sets and networks for counts: [spect.md](../spect.md). Parallel-hole collimators
# are not supported.
