# %% [markdown]
# # A new weighting network as a plugin
#
# `cross_view` compares each camera's estimate of the volume with the other cameras' estimates. Its weighting network converts this
# comparison to a weight for each camera and cell. With faulty cameras these weights are the part that matters most
# ([ablations](../../experiments/21_faults/ablations.md)). This page writes a weighting network, checks its contract, compares it with the
# built-in one, and turns it into a project for pip. A head, another part of the model, is written in the same way.

# %%
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.apps.list import new_plugin
from mvrecon.core.parts import HEADS, SCENES, WEIGHTINGS
from mvrecon.methods.learned.cross_view import CrossView
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.methods.learned.weightings import CHANNELS
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png
from mvrecon.testing import check_head, check_weighting

# %% [markdown]
# ## Write it
#
# A weighting network is built with the number of its input channels. It gets the channels of all cameras on the coarse grid of the
# estimates, `[b m c e i x]`, and the cells that each camera sees, `[m 1 e i x]`. It returns one logit for each camera and cell,
# `[b m 1 e i x]`; the softmax over the cameras that see a cell gives their weights.

# %%
print(*CHANNELS, sep="\n")

# %% [markdown]
# The built-in `unet` learns the logits from all channels. The new one is a rule of robust statistics with two learned numbers: the
# weight is proportional to 1 / (1 + e / s)^p, for p = 1 a Cauchy weight. Here e is the mean square of the residual that the other
# cameras' estimates leave unexplained in the view of this camera, over the cells that it sees.


# %%
@WEIGHTINGS.register("robust")
class Robust(torch.nn.Module):
    """Cauchy weights of the unexplained residual, with learned scale and power."""

    def __init__(self, inputs):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.zeros(()))
        self.power = torch.nn.Parameter(torch.zeros(()))

    def forward(self, inputs, visible):
        """Inputs [b m c e i x] and seen cells [m 1 e i x] to logits [b m 1 e i x]."""
        channel = CHANNELS.index("unexplained")
        squares = inputs[:, :, channel : channel + 1].square() * visible
        cells = visible.sum(dim=(2, 3, 4), keepdim=True).clamp_min(1)
        mean = squares.sum(dim=(3, 4, 5), keepdim=True) / cells
        return (-self.power.exp() * (mean / self.scale.exp()).log1p()).expand_as(squares)


# %% [markdown]
# ## Check it
#
# `check_weighting` tests the contract: one logit for each camera and cell, for any number of cameras and any grid; logits that follow
# their cameras in another order and do not depend on the other samples; finite values and gradients, also for inputs of zero; and a
# gradient for every parameter. It calls the network with and without the last channel, as a model without a depth
# network (`method.depth=prior method.depth_widths=[]`) has no confidence.

# %%
check_weighting("robust")
print(f"weighting networks: {', '.join(WEIGHTINGS.names())}")

# %% [markdown]
# ## Compare it
#
# Three trainings that differ in the weights of the cameras only: same seed, same phantoms, same faults, same steps. In every case
# two of eight detectors are displaced by two pixels, and their views are 15 % too bright; the model is not told which.

# %%
grid = mv.Grid.centred(16, spacing=8.0)  # mm
cameras = mv.circular(8, 400.0, 800.0, {"pixels": [20, 20], "pixel_mm": 14.0})
A = mv.Drr(grid, cameras)
scene = SCENES.build("ellipsoids", value=0.02)  # at most 0.02 / mm


def phantoms(seed, count):
    """Exact views [b 1 m v u] and volumes [b 1 d h w]."""
    samples = [scene.sample(n, seed, grid, cameras) for n in range(count)]
    return torch.stack([s.views for s in samples]), torch.stack([s.volume for s in samples])


def faulty(views):
    """Views of which two of each case are displaced and too bright; which ones they are [b m]."""
    wrong = torch.rand(len(views), len(cameras)).argsort(dim=1) < 2
    displaced = 1.15 * views.roll(2, dims=-1)
    return torch.where(wrong[:, None, :, None, None], displaced, views), wrong


training = phantoms(seed=1, count=48)


def trained(steps=50, batch=4, **options):
    """A small cross-view model with these options, trained for a few seconds."""
    torch.manual_seed(0)
    small = {
        "widths": [8, 16],
        "depth_widths": [8],
        "scale": 1,
        "binning": 2,
        "start": 10,
        "consistency": 1,
        "ray_widths": [],  # rays count by their camera's weights alone
    }
    method = CrossView(**small, **options)
    optimiser = torch.optim.AdamW(method.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=3e-3, total_steps=steps)
    for _ in range(steps):
        chosen = torch.randint(len(training[0]), (batch,))
        views, truth = (part[chosen] for part in training)
        loss = (method(faulty(views)[0], A).volume - truth).square().sum() / truth.square().sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return method.eval()


torch.manual_seed(0)
clean, truth = phantoms(seed=3, count=6)
views, wrong = faulty(clean)
volumes = {"SIRT": mv.sirt(A, views, iterations=20)}
shares = {}
for name in ("mean", "unet", "robust"):
    choice = {"fusion": "mean"} if name == "mean" else {"weighting": name}
    out = trained(**choice)(views, A)
    volumes[name] = out.volume.detach()
    shares[name] = out.camera_weights[wrong].mean().item() * len(cameras)

inside, shown, means = torch.ones(1, *grid.shape, dtype=torch.bool), {}, {}
for name, volume in volumes.items():
    pairs = zip(volume, truth, strict=True)
    scores = [float(volume_metrics(x, t, inside, scene.data_range)["psnr"]) for x, t in pairs]
    means[name] = sum(scores) / len(scores)
    weight = f", weight of a faulty camera {shares[name]:.2f}" if name in shares else ""
    print(f"{name:7} {means[name]:.1f} dB{weight}")
    shown[f"{name}\n{scores[0]:.1f} dB"] = volume[0, 0]
case = review.CaseSheets("an unseen phantom", grid, float(truth[0].max()), scene.unit)
save_png("planes.png", review.planes(case, truth[0, 0], shown))
assert min(means["unet"], means["robust"]) > means["mean"] + 0.5 > means["SIRT"], means
assert max(shares["unet"], shares["robust"]) < 0.6, shares

# %% [markdown]
# The weight is relative to equal weights, the `mean`. Both networks find the faulty cameras of phantoms that they have not seen, and both
# volumes gain from it. A run this short cannot rank them: train longer, on your data and with several seeds, as
# [compare_heads.md](../compare_heads.md) does for heads; it applies to `method.weighting=unet,robust` as well.

# %% [markdown]
# ## A head instead
#
# Other parts follow the same steps: a class, `register`, and the check of its kind. A head converts the depth network's logits in a camera's
# frustum to that camera's density along its rays. The default, `softmax_depth`, distributes each measured integral along its ray, so
# every estimate reproduces its own view. Noise in the view then enters the estimate. This head multiplies the prior instead: zero logits
# leave it unchanged, and the measurement enters through the network alone. `keeps_views = False` declares that.


# %%
@HEADS.register("factor")
class Factor(torch.nn.Module):
    """The prior density times exp(logits), with a floor so that zeros can grow."""

    keeps_views = False

    def forward(self, logits, prior, views, frusta):
        """Logits and prior [b m 1 D v u], and measured views [b 1 m v u], to a density [b m 1 D v u] in (unit of the views) / mm."""
        floor = 0.01 * prior.abs().mean(dim=(1, 2, 3, 4, 5), keepdim=True)
        return (prior.clamp_min(0) + floor) * logits.clamp(-3, 3).exp() * frusta.occupied


check_head("factor", Frusta.of(grid, cameras, depth=16))
print(f"heads: {', '.join(HEADS.names())}")

# %% [markdown]
# `check_head` tests `keeps_views`, shapes, finite values on rays that miss (it makes some miss), and zeros outside the region.
# `frusta.step` is the length of ray in a bin in mm. Differences between heads are small: [compare_heads.md](../compare_heads.md).

# %% [markdown]
# ## Share it
#
# `mvrecon-list --new-plugin my_plugin` writes a project with one part of each kind, tests included; the next line is that command.
# Put the class into its `weighting.py`, and `"weighting.robust" = "my_plugin.weighting:Robust"` into its `pyproject.toml`. After
# `pip install -e my_plugin`, `mvrecon-list weighting` lists the network, and `mvrecon-train experiment=smoke method.weighting=robust`
# trains with it for a few seconds.

# %%
if not Path("my_plugin").exists():  # a second run of this page keeps the project
    for file in new_plugin("my_plugin", Path.cwd()):
        print(file.relative_to(Path.cwd()))

# %% [markdown]
# Without a project, `mvrecon-train experiment=quickstart plugins=[my_parts] method.weighting=robust` imports a single file `my_parts.py`
# with the class. The other kinds of parts: [plugins/README.md](../../plugins/README.md).
