# %% [markdown]
# # Your own training loop
#
# Operators and learned methods are plain `torch.nn.Module`s. `mvrecon-train` adds Lightning, checkpoints and TensorBoard; your own loop
# needs none of them.

# %%
import torch

import mvrecon as mv
from mvrecon.core.parts import SCENES
from mvrecon.methods.learned.cross_view import CrossView
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.training.export import save_png

torch.manual_seed(0)
grid = mv.Grid.centred(16, spacing=8.0)
cameras = mv.circular(4, 400.0, 800.0, {"pixels": [20, 20], "pixel_mm": 14.0})
A = mv.Drr(grid, cameras)
scene = SCENES.build("ellipsoids")


def batch(seed, cases):
    """Exact views [b 1 m v u] and the truth [b 1 d h w]; a pure function of seed and case."""
    samples = [scene.sample(n, seed, grid, cameras) for n in cases]
    return torch.stack([s.views for s in samples]), torch.stack([s.volume for s in samples])


# %% [markdown]
# ## A method
#
# A method maps views and an operator to a reconstruction; its weights contain no geometry. Here the cross-view model, small enough
# for a demonstration. Other learned methods of `mvrecon-list method` are used alike.

# %%
method = CrossView(widths=[8, 16], depth_widths=[8], scale=1, depths=8, start=4, consistency=1)
print(f"{sum(p.numel() for p in method.parameters())} weights")

# %% [markdown]
# ## The loop

# %%
optimiser = torch.optim.AdamW(method.parameters(), lr=3e-3)
losses = []
for step in range(24):
    views, truth = batch(seed=1, cases=[2 * step, 2 * step + 1])
    out = method(views, A)  # a Reconstruction: the volume, per-view estimates, weights
    views_too = (A(out.volume) - views).square().mean() / views.square().mean()
    loss = (out.volume - truth).square().mean() / truth.square().mean() + 0.1 * views_too
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    losses.append(loss.item())
print(f"loss {sum(losses[:6]) / 6:.3f} in the first steps, {sum(losses[-6:]) / 6:.3f} in the last")
assert sum(losses[-6:]) < sum(losses[:6])

# %% [markdown]
# ## Unseen cases
#
# Another seed gives cases that training never sees. After so few steps this shows how to evaluate, not how good the method gets.

# %%
method.eval()
views, truth = batch(seed=2, cases=[0])
with torch.no_grad():
    volumes = {"network": method(views, A).volume, "SIRT": mv.sirt(A, views, iterations=50)}
inside = torch.ones_like(truth[0], dtype=torch.bool)
for name, volume in volumes.items():
    psnr = volume_metrics(volume[0], truth[0], inside, scene.data_range)["psnr"]
    print(f"{name}: {float(psnr):.1f} dB")
shown = {name: volume[0, 0] for name, volume in volumes.items()}
case = review.Case("unseen", grid, scene.data_range, scene.unit)
save_png("planes.png", review.planes(case, truth[0, 0], shown))

# %% [markdown]
# ## What to keep
#
# `torch.save(method.state_dict(), ...)` keeps the weights, `torch.compile(method)` treats operators as opaque steps, and
# `mvrecon.training.trained.exported(method, A, views)` is a program of `torch.export`: [python.md](../python.md).
