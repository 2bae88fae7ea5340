# %% [markdown]
# # Operators and gradients
#
# A projector is a linear operator: `A(x)` projects a volume to views, and `A.T(y)` is its exact transpose. Both are differentiable. Every
# claim on this page is checked by an `assert`.

# %%
import torch
from matplotlib.figure import Figure

import mvrecon as mv
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png

grid = mv.Grid.centred(size=(32, 32, 24), spacing=4.0)  # voxels and mm along (x, y, z)
cameras = mv.circular(12, 400.0, 800.0, {"pixels": [40, 48], "pixel_mm": 6.0})  # mm
A = mv.Drr(grid, cameras)
x = mv.phantom("shepp_logan", grid, cameras, value=0.02).volume[None]  # [b c d h w], in 1/mm
y = A(x)  # [b c m v u], line integrals in (unit of x) * mm
print(f"volume {tuple(x.shape)} -> views {tuple(y.shape)}")
save_png("views.png", review.mosaic(y[0, 0, :4], "Shepp-Logan phantom", "1/mm * mm"))

# %% [markdown]
# ## The adjoint is exact
#
# `A.T` uses the same weights as `A`, so <A a, b> = <a, A.T b> for any a and b, here to the rounding of float64.

# %%
a = torch.rand(1, 1, *A.domain_shape, dtype=torch.float64)
b = torch.rand(1, 1, *A.range_shape, dtype=torch.float64)
left, right = (A(a) * b).sum(), (a * A.T(b)).sum()
print(f"<A a, b> = {left:.12g}, <a, A.T b> = {right:.12g}")
assert (left - right).abs() < 1e-12 * left

# %% [markdown]
# ## Gradients in the volume and in the geometry
#
# The gradient of half the squared residual is A.T (A x - y), and autograd returns the same. Camera tensors that require a gradient
# get one, too.

# %%
volume = torch.zeros_like(a).requires_grad_()
(0.5 * (A(volume) - b).square().sum()).backward()
assert torch.allclose(volume.grad, A.T(A(volume.detach()) - b), rtol=1e-12)

source = cameras.source.clone().requires_grad_()
moved = mv.Cameras(source, cameras.origin, cameras.u, cameras.v, cameras.shape)
mv.Drr(grid, moved)(x).square().sum().backward()
print(f"gradient with respect to the position of source 0, per mm: {source.grad[0].tolist()}")

# %% [markdown]
# ## What is exact, and what is an approximation
#
# `siddon` treats a voxel as a constant cell: a box of ones integrates to its chord. `joseph`, the default, interpolates; its error is of
# second order in the voxel size where the object is smooth, and of first order at edges, of which this phantom has many. `mv.phantom` returns
# its line integrals in closed form:

# %%
beam = mv.circular(1, 400.0, 800.0, {"pixels": [1, 1], "pixel_mm": 1.0})  # along an axis
length = mv.Drr(grid, beam, method="siddon")(torch.ones_like(x)).item()
print(f"a box of ones along the central ray: {length:.6f} mm; the box is {32 * 4.0} mm wide")
assert abs(length - 32 * 4.0) < 1e-3

for size, mm in ((16, 8.0), (32, 4.0), (64, 2.0)):
    fine = mv.Grid.centred(size=size, spacing=mm)
    truth = mv.phantom("shepp_logan", fine, cameras)
    error = (mv.Drr(fine, cameras)(truth.volume[None])[0] - truth.views).norm()
    print(f"voxels of {mm} mm: relative error of the views {error / truth.views.norm():.2%}")

# %% [markdown]
# ## Zeros cost nothing
#
# Empty space is detected and skipped, with the same bits in the views. By default this happens where it pays; here it is requested.

# %%
small = torch.zeros_like(x)
small[..., 8:16, 10:20, 12:22] = 1.0
B = mv.Drr(grid, cameras, skip="box")
assert torch.equal(B(small), mv.Drr(grid, cameras, skip="off")(small))
print(f"{B.skipped.fractions['voxels']:.1%} of the voxels were read")

# %% [markdown]
# ## Epipolar lines
#
# The ray of a pixel in one camera is a line in every other camera. Points along the ray of a pixel of camera 0 lie on that line in camera 2:

# %%
pixel = torch.tensor([[27.0, 16.0]], dtype=torch.float64)  # (u, v)
depths = torch.linspace(350.0, 450.0, 6, dtype=torch.float64)  # mm from the source
ray = cameras[0].unproject(torch.cat([pixel.expand(6, 2), depths[:, None]], dim=1)[None])[0]
seen = cameras[2].project(ray)[0]  # (u, v, z) of these points
line = mv.epipolar_line(cameras, 0, 2, pixel)[0]  # a u + b v + c = 0, a^2 + b^2 = 1
assert (seen[:, :2] @ line[:2] + line[2]).abs().max() < 1e-6

figure = Figure(figsize=(7, 3), layout="constrained")
left, right = figure.subplots(1, 2)
for axes, view, name in ((left, 0, "camera 0: a pixel"), (right, 2, "camera 2: its epipolar line")):
    shown = axes.imshow(y[0, 0, view].numpy(), cmap="gray", vmin=0, vmax=float(y.max()))
    axes.set(title=name, xlabel="u, pixels", ylabel="v, pixels")
figure.colorbar(shown, ax=[left, right], label="line integral of attenuation", shrink=0.8)
left.plot(*pixel[0].tolist(), "r+", markersize=12)
u = torch.tensor([0.0, y.shape[-1] - 1.0], dtype=torch.float64)
right.plot(u.numpy(), (-(line[0] * u + line[2]) / line[1]).numpy(), "r")
figure.savefig("epipolar.png")

# %% [markdown]
# ## Your own reconstruction in ten lines
#
# With gradients, a torch optimiser and any penalty make a reconstruction: here Adam with total variation, from twelve views with 1 % noise. The
# views are projections by the same operator, so both errors are smaller than those of a scan.
# Built-in methods such as SIRT need only `A` and `A.T`, so they take products, parts and plugins' operators as well.

# %%
torch.manual_seed(0)
noisy = y + 0.01 * y.max() * torch.randn_like(y)
parameter = torch.zeros_like(x).requires_grad_()
optimiser = torch.optim.Adam([parameter], lr=0.001)
for _ in range(80):
    residual = (A(parameter) - noisy).square().sum() / noisy.square().sum()
    steps = [parameter.diff(dim=axis).square() for axis in (2, 3, 4)]
    variation = sum((step + 4e-8).sqrt().mean() for step in steps)
    optimiser.zero_grad()
    (residual + 5 * variation).backward()
    optimiser.step()
    parameter.data.clamp_(min=0)

volumes = {"SIRT": mv.sirt(A, noisy, iterations=40), "Adam + TV": parameter.detach()}
inside, shown, scores = torch.ones(1, *grid.shape, dtype=torch.bool), {}, []
for name, volume in volumes.items():
    scores.append(float(volume_metrics(volume[0], x[0], inside, 0.02)["psnr"]))
    shown[f"{name}\n{scores[-1]:.1f} dB"] = volume[0, 0]
    print(f"{name}: {scores[-1]:.1f} dB")
assert scores[1] > scores[0]
case = review.CaseSheets("twelve noisy views", grid, float(x.max()), "1/mm")
save_png("planes.png", review.planes(case, x[0, 0], shown))
