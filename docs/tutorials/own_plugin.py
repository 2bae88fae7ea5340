# %% [markdown]
# # A new head as a plugin
#
# A head converts a network's output in a camera's frustum to that camera's density along its rays. This page writes one, checks its
# contract, compares it with the built-in head, and turns it into a project for pip.

# %%
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.apps.list import new_plugin
from mvrecon.core.parts import HEADS, SCENES
from mvrecon.methods.learned.cross_view import CrossView
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.testing import check_head
from mvrecon.training.export import save_png

# %% [markdown]
# ## Write it
#
# The default, `softmax_depth`, distributes each measured integral along its ray, so every estimate reproduces its own view. Noise in the
# view then enters the estimate. The new head multiplies the prior instead: zero logits leave it unchanged, and the measurement enters
# through the network alone. `keeps_views = False` declares that.


# %%
@HEADS.register("factor")
class Factor(torch.nn.Module):
    """The prior density times exp(logits), with a floor so that zeros can grow."""

    keeps_views = False

    def forward(self, logits, prior, views, frusta):
        """Logits and prior [b m 1 D v u], and measured views [b 1 m v u], to a density [b m 1 D v u] in (unit of the views) / mm."""
        floor = 0.01 * prior.abs().mean(dim=(1, 2, 3, 4, 5), keepdim=True)
        return (prior.clamp_min(0) + floor) * logits.clamp(-3, 3).exp() * frusta.occupied


# %% [markdown]
# ## Check it
#
# `check_head` tests the contract of heads: `keeps_views`, shapes, finite values on rays that miss (it makes some miss), and zeros
# outside the region. `frusta.step` is the length of ray in a bin in mm.

# %%
grid = mv.Grid.centred(16, spacing=8.0)  # mm
cameras = mv.circular(4, 400.0, 800.0, {"pixels": [20, 20], "pixel_mm": 14.0})
A = mv.Drr(grid, cameras)
check_head("factor", Frusta.of(grid, cameras, depth=16))
print(f"heads: {', '.join(HEADS.names())}")

# %% [markdown]
# ## Compare it
#
# Two trainings that differ in the head only: same seed, same phantoms, same noise, same steps.

# %%
scene = SCENES.build("ellipsoids", value=0.02)  # at most 0.02 / mm


def phantoms(seed, count):
    """Noise-free views [b 1 m v u] and volumes [b 1 d h w]."""
    samples = [scene.sample(n, seed, grid, cameras) for n in range(count)]
    return torch.stack([s.views for s in samples]), torch.stack([s.volume for s in samples])


def measured(views, photons=1e4):
    """Line integrals with the noise of so many photons a pixel."""
    return views + (views.exp() / photons).sqrt() * torch.randn_like(views)


training = phantoms(seed=1, count=48)


def trained(head, steps=50, batch=4):
    """A small cross-view model with this head, trained for a few seconds."""
    torch.manual_seed(0)
    options = {"widths": [8, 16], "depth_widths": [8], "scale": 1, "depths": 8}
    method = CrossView(**options, start=10, consistency=1, head=head)
    optimiser = torch.optim.AdamW(method.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=3e-3, total_steps=steps)
    for _ in range(steps):
        chosen = torch.randint(len(training[0]), (batch,))
        views, truth = (part[chosen] for part in training)
        loss = (method(measured(views), A).volume - truth).square().sum() / truth.square().sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return method.eval()


clean, truth = phantoms(seed=3, count=6)
views = measured(clean)
volumes = {"SIRT": mv.sirt(A, views, iterations=20)}
for head in ("softmax_depth", "factor"):
    volumes[head] = trained(head)(views, A).volume.detach()

inside, shown, means = torch.ones(1, *grid.shape, dtype=torch.bool), {}, {}
for name, volume in volumes.items():
    pairs = zip(volume, truth, strict=True)
    scores = [float(volume_metrics(x, t, inside, scene.data_range)["psnr"]) for x, t in pairs]
    means[name] = sum(scores) / len(scores)
    print(f"{name:14} {means[name]:.1f} dB")
    shown[f"{name}\n{scores[0]:.1f} dB"] = volume[0, 0]
case = review.CaseSheets("an unseen phantom", grid, float(truth[0].max()), scene.unit)
save_png("planes.png", review.planes(case, truth[0, 0], shown))
assert min(means["softmax_depth"], means["factor"]) > means["SIRT"] + 0.5, means

# %% [markdown]
# Both heads train; a run this short cannot rank them. To compare heads, train longer, on your data and with several seeds:
# [compare_heads.md](../compare_heads.md).

# %% [markdown]
# ## Share it
#
# `mvrecon-list --new-plugin my_plugin` writes a project with one part of each kind, tests included; the next line is that command.
# Put the class into its `head.py`, and `"head.factor" = "my_plugin.head:Factor"` into its `pyproject.toml`. After `pip install -e my_plugin`,
# `mvrecon-list head` lists the head, and `mvrecon-train experiment=smoke method.head=factor` trains with it for a few seconds.

# %%
if not Path("my_plugin").exists():  # a second run of this page keeps the project
    for file in new_plugin("my_plugin", Path.cwd()):
        print(file.relative_to(Path.cwd()))

# %% [markdown]
# Without a project, `mvrecon-train experiment=quickstart plugins=[my_parts] method.head=factor` imports a single file `my_parts.py` with the
# class. The other kinds of parts: [plugins/README.md](../../plugins/README.md).
