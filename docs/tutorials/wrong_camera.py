# %% [markdown]
# # Find a misaligned camera
#
# Three of eight detectors are displaced from their nominal positions, and one of them is too bright. The views alone reveal which ones
# and by how much: `self_aligned` alternates between reconstructing and aligning each view to the re-projection.

# %%
import torch
from matplotlib.figure import Figure

import mvrecon as mv
from mvrecon.core.parts import SCENES
from mvrecon.methods.calibration.self_alignment import self_aligned
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png

grid = mv.Grid.centred(32, spacing=4.0)  # mm
nominal = mv.circular(8, 400.0, 800.0, {"pixels": [44, 44], "pixel_mm": 6.5}, start_degrees=10.0)
scene = SCENES.build("ellipsoids", value=0.02)  # at most 0.02 / mm

# %% [markdown]
# ## A scanner with three faults
#
# The true rig has the detectors of cameras 1, 4 and 6 displaced along u and v; the view of camera 4 is 6 % too bright.

# %%
shift_px = torch.zeros(8, 2, dtype=torch.float64)  # (u, v)
shift_px[1] = torch.tensor([1.5, 0.0])
shift_px[4] = torch.tensor([-1.0, 0.8])
shift_px[6] = torch.tensor([0.0, -1.6])
gain = torch.ones(8)
gain[4] = 1.06
moved = nominal.origin + shift_px[:, :1] * nominal.u + shift_px[:, 1:] * nominal.v
true_rig = mv.Cameras(nominal.source, moved, nominal.u, nominal.v, nominal.shape)

case = scene.sample(7, seed=0, grid=grid, cameras=true_rig)
truth = case.volume[None]  # [1 1 d h w]
views = case.views[None] * gain[:, None, None]  # [1 1 m v u], exact integrals of the true rig

# %% [markdown]
# ## Find them
#
# The reconstruction uses the nominal rig.

# %%
A = mv.Drr(grid, nominal)
corrected = self_aligned(A, views)
found = corrected.alignment
for camera in range(8):
    u, v = found.shift_px[0, camera].tolist()
    wrong = " <- wrong" if max(abs(u), abs(v)) > 0.3 else ""
    print(
        f"camera {camera}: shift ({u:+.2f}, {v:+.2f}) pixels, gain {found.gain[0, camera]:.3f}{wrong}"
    )
error = (found.shift_px[0] - shift_px).abs().max()
print(f"largest error of a shift: {error:.2f} pixels")
assert error < 0.3 and abs(found.gain[0, 4] - 1.06) < 0.02

figure = Figure(figsize=(7, 2.4), layout="constrained")
axes = figure.subplots()
cameras = torch.arange(8)
axes.bar(cameras - 0.2, shift_px.norm(dim=1), 0.4, label="true")
axes.bar(cameras + 0.2, found.shift_px[0].norm(dim=1), 0.4, label="found from the views")
axes.set(xlabel="camera", ylabel="detector shift, pixels", xticks=cameras)
axes.legend()
figure.savefig("shifts.png")

# %% [markdown]
# ## Before and after
#
# The corrected views replace the measured ones in any method. The last column, from a perfect scanner, is the upper limit of
# alignment.

# %%
perfect = scene.sample(7, seed=0, grid=grid, cameras=nominal).views[None]
inside = torch.ones_like(truth[0], dtype=torch.bool)
shown, scores = {}, []
for name, y in {"as measured": views, "aligned": corrected.views, "perfect rig": perfect}.items():
    volume = mv.sirt(A, y, iterations=25, momentum=True)
    scores.append(float(volume_metrics(volume[0], truth[0], inside, scene.data_range)["psnr"]))
    shown[f"{name}\n{scores[-1]:.1f} dB"] = volume[0, 0]
    print(f"{name}: {scores[-1]:.1f} dB")
assert scores[1] > scores[0] + 3
sheet = review.CaseSheets("SIRT from eight views", grid, float(truth.max()), scene.unit)
save_png("planes.png", review.planes(sheet, truth[0, 0], shown))

# %% [markdown]
# For a scan on disk add `correct=align` to `mvrecon-reconstruct`. For an error that all views share, such as an axis that is 2
# pixels off or a tilted detector, use `calibrate=[offset_u,tilt]`: [calibration.md](../calibration.md).
