# %% [markdown]
# # Your own training loop
#
# Operators and models are plain `torch.nn.Module`s. `mvrecon-train` adds Lightning, checkpoints and a board; a loop of one's own
# needs neither.

# %%
import torch

import mvrecon as mv
from mvrecon.engine.export import save_png
from mvrecon.metrics import volume_metrics
from mvrecon.parts import MODELS, SCENES
from mvrecon.viz import review

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
# ## A model
#
# `cross_view` with one round at full resolution and no cameras' networks is a U-Net in the world between a classical start and steps
# of data consistency. Any of `mvrecon-list model` is built alike.

# %%
world = {"resolution": "full", "widths": [8, 16], "cameras": None, "opinions": None}
model = MODELS.build("cross_view", projector=A, rounds=[world], start=4, consistency=1)
print(f"{sum(p.numel() for p in model.parameters())} weights")

# %% [markdown]
# ## The loop

# %%
optimiser = torch.optim.AdamW(model.parameters(), lr=3e-3)
losses = []
for step in range(24):
    views, truth = batch(seed=1, cases=[2 * step, 2 * step + 1])
    out = model(views)  # a Reconstruction: volume, and what led to it
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
# Another seed gives cases that training never sees. After so few steps this shows how to judge, not how good the model gets.

# %%
model.eval()
views, truth = batch(seed=2, cases=[0])
with torch.no_grad():
    volumes = {"network": model(views).volume, "SIRT": mv.sirt(A, views, iterations=50)}
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
# `torch.save(model.state_dict(), ...)` keeps the weights, `torch.compile(model)` takes operators as opaque steps, and
# `mvrecon.engine.program.exported(model, views)` is a program of `torch.export`: [python.md](../python.md).
