# %% [markdown]
# # Train a network and compare it
#
# A U-Net that starts from SIRT learns to reconstruct from four noisy views: ten seconds of training on a CPU, in a plain PyTorch
# loop. Operators and methods are `torch.nn.Module`s; `mvrecon-train` adds Lightning, checkpoints and TensorBoard to the same parts.

# %%
import torch

import mvrecon as mv
from mvrecon.core.parts import SCENES
from mvrecon.methods.learned.baselines import VolumeUNet
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png

torch.manual_seed(0)
grid = mv.Grid.centred(16, spacing=8.0)  # mm
cameras = mv.circular(4, 400.0, 800.0, {"pixels": [20, 20], "pixel_mm": 14.0})
A = mv.Drr(grid, cameras)
scene = SCENES.build("ellipsoids", value=0.02)  # at most 0.02 / mm, the attenuation of water


def phantoms(seed, count):
    """Noise-free views [b 1 m v u] and volumes [b 1 d h w]; the seed separates training from test."""
    samples = [scene.sample(n, seed, grid, cameras) for n in range(count)]
    return torch.stack([s.views for s in samples]), torch.stack([s.volume for s in samples])


def measured(views, photons=1e4):
    """Line integrals with Poisson-like noise, for a number of photons per pixel in air."""
    return views + (views.exp() / photons).sqrt() * torch.randn_like(views)


# %% [markdown]
# ## The loop
#
# The volume loss alone; every step draws new noise. A method takes views and an operator, and its weights contain no geometry.

# %%
method = VolumeUNet(widths=[16, 32], start=10)
steps, batch = 100, 4
optimiser = torch.optim.AdamW(method.parameters())
schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=5e-3, total_steps=steps)
views, volumes = phantoms(seed=1, count=96)
losses = []
for _ in range(steps):
    chosen = torch.randint(len(views), (batch,))
    truth = volumes[chosen]
    out = method(measured(views[chosen]), A).volume
    loss = (out - truth).square().sum() / truth.square().sum()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    schedule.step()
    losses.append(loss.item())
print(f"{sum(p.numel() for p in method.parameters())} parameters")
print(
    f"loss {sum(losses[:10]) / 10:.3f} in the first ten steps, {sum(losses[-10:]) / 10:.3f} in the last ten"
)

# %% [markdown]
# ## Compare on unseen phantoms
#
# A fair comparison tunes the classical methods, too: of each the best of several settings, chosen on phantoms that are in neither set.

# %%
inside = torch.ones(1, *grid.shape, dtype=torch.bool)


def psnr(reconstructed, truth):
    """Mean PSNR of a batch, in dB."""
    pairs = zip(reconstructed, truth, strict=True)
    values = [volume_metrics(x, t, inside, scene.data_range)["psnr"] for x, t in pairs]
    return float(sum(values) / len(values))


def best(candidates):
    """The candidate with the highest PSNR on the validation phantoms."""
    clean, truth = phantoms(seed=2, count=4)
    noisy = measured(clean)
    return max(candidates, key=lambda f: psnr(f(noisy), truth))


sirt = best([lambda y, n=n: mv.sirt(A, y, iterations=n) for n in (5, 10, 20, 40)])
tv = best([lambda y, w=w: mv.fista_tv(A, y, weight=w) for w in (3e-4, 1e-3, 3e-3)])
method.eval()
clean, truth = phantoms(seed=3, count=6)
noisy = measured(clean)
with torch.no_grad():
    results = {"SIRT": sirt(noisy), "TV": tv(noisy), "U-Net": method(noisy, A).volume}
scores = {name: psnr(x, truth) for name, x in results.items()}
print("\n".join(f"{name:6} {score:.1f} dB" for name, score in scores.items()))
assert scores["U-Net"] > scores["SIRT"] + 1.5

case = review.CaseSheets(
    "an unseen phantom, four noisy views", grid, float(truth[0].max()), scene.unit
)
shown = {f"{name}\n{psnr(x[:1], truth[:1]):.1f} dB": x[0, 0] for name, x in results.items()}
save_png("planes.png", review.planes(case, truth[0, 0], shown))

# %% [markdown]
# ## Save it
#
# `torch.save(method.state_dict(), ...)` saves the weights, `torch.compile(method)` treats operators as opaque steps, and
# `mvrecon.training.program.exported(method, A, views)` returns a program of `torch.export`: [python.md](../python.md). The same comparison
# with checkpoints, intervals and one table is a command: `mvrecon-train experiment=quickstart`.
