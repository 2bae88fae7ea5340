# %% [markdown]
# # Register a CT to two X-ray views
#
# A CT is known, and so is the C-arm; two X-ray views show the object turned and shifted by an unknown rigid motion. Here the CT is a
# phantom of ellipsoids. Six numbers are found by gradient descent through `mv.Drr`, whose views are differentiable in the pose of the cameras.

# %%
import torch
from matplotlib.figure import Figure
from torch.nn.functional import avg_pool2d

import mvrecon as mv

grid = mv.Grid.centred(64, spacing=2.0)  # mm
detector = {"pixels": [96, 96], "pixel_mm": 2.5}
c_arm = mv.circular(2, 600.0, 900.0, detector, arc_degrees=180.0)  # two views, 90 degrees apart
ct = mv.phantom("ellipsoids", grid, c_arm, case=3, value=0.02).volume[None]  # [1 1 d h w], 1/mm

# %% [markdown]
# ## Pose and similarity
#
# A pose is a rotation vector in degrees and a translation in mm. Moving the cameras by X -> R X + t has the same views as moving the
# patient by the inverse. The similarity is the correlation of both images, which no difference in exposure changes.


# %%
def motion(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """R [3 3] and t [3] in mm of six parameters: a rotation vector in degrees, then t."""
    x, y, z = pose[:3].deg2rad()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return torch.linalg.matrix_exp(skew), pose[3:]


def correlation(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Normalised cross-correlation of views [m v u], the mean over the views."""
    one, other = (y - y.mean((-2, -1), keepdim=True) for y in (one, other))
    norms = one.norm(dim=(-2, -1)) * other.norm(dim=(-2, -1))
    return ((one * other).sum((-2, -1)) / norms).mean()


# %% [markdown]
# ## Descent from coarse to fine
#
# Coarse pixels have few local maxima, fine pixels give the accuracy. Each step projects the CT once, and back-propagates once to the
# six parameters; no gradient of the volume is computed.


# %%
def register(ct: torch.Tensor, views: torch.Tensor, steps: int = 40) -> torch.Tensor:
    """The pose [6] of `c_arm` whose projections of the CT correlate best with views [m v u]."""
    pose = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    for pixels in (4, 2, 1):
        adam = torch.optim.Adam([pose], lr=pixels / 2)  # degrees, mm
        target = avg_pool2d(views, pixels)
        for _ in range(steps):
            projected = mv.Drr(grid, c_arm.moved(*motion(pose)))(ct)[0, 0]
            loss = 1 - correlation(avg_pool2d(projected, pixels), target)
            adam.zero_grad()
            loss.backward()
            adam.step()
    return pose.detach()


# %% [markdown]
# ## Eight poses
#
# Up to 15 degrees about and 20 mm along each axis. The views are the closed-form integrals of the object, not projections of the CT by
# the same operator. The error of the position is at the centre of the CT.

# %%
generator = torch.Generator().manual_seed(0)
errors = []
for _ in range(8):
    true = (2 * torch.rand(6, generator=generator, dtype=torch.float64) - 1) * torch.tensor(
        [15.0, 15.0, 15.0, 20.0, 20.0, 20.0]
    )
    moved = c_arm.moved(*motion(true))
    views = mv.phantom("ellipsoids", grid, moved, case=3, value=0.02).views[0]
    found = register(ct, views)
    (R, t), (R0, t0) = motion(found), motion(true)
    turn = ((torch.trace(R.mT @ R0) - 1) / 2).clamp(-1, 1).acos().rad2deg()
    errors.append([float(turn), float((R.mT @ t - R0.mT @ t0).norm())])
    print(
        f"{true[:3].norm():4.1f} degrees and {true[3:].norm():4.1f} mm away: "
        f"found within {errors[-1][0]:.2f} degrees and {errors[-1][1]:.2f} mm"
    )
assert max(degrees for degrees, _ in errors) < 0.3 and max(mm for _, mm in errors) < 0.3

# %%
before = mv.Drr(grid, c_arm)(ct)[0, 0]
after = mv.Drr(grid, c_arm.moved(*motion(found)))(ct)[0, 0]
figure = Figure(figsize=(8, 4.4), layout="constrained")
shown = {
    "measured": views,
    "before: difference": before - views,
    "after: difference": after - views,
}
top = float(views.max())
for column, (title, pictures) in enumerate(shown.items()):
    for row, picture in enumerate(pictures):
        axes = figure.add_subplot(2, 3, 3 * row + column + 1)
        axes.set(title=f"view {row}, {title}" if row == 0 else f"view {row}", xticks=[], yticks=[])
        limits = (0, top) if column == 0 else (-top / 4, top / 4)
        image = axes.imshow(picture, cmap="gray", vmin=limits[0], vmax=limits[1])
        figure.colorbar(image, label="line integral" if column == 2 else None)
figure.savefig("registered.png")

# %% [markdown]
# With one view (`mv.circular(1, ...)`), depth is known only from the magnification, and positions are up to 0.9 mm off
# ([study 31](../../experiments/31_registration/README.md): 50 starts, beside nanodrr). The same gradients
# refine any parameter of a rig: source, detector, pixel vectors ([operators.md](../operators.md)).
