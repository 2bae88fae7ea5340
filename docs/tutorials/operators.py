# %% [markdown]
# # Operators in ten minutes
#
# A projector is a linear operator A: `A(x)` are the views of a volume, `A.T(y)` is its transpose. What is said of it here is
# checked by an `assert`.

# %%
import torch
from matplotlib.figure import Figure

import mvrecon as mv
from mvrecon.core.parts import SCENES
from mvrecon.report.viz import review
from mvrecon.training.export import save_png

grid = mv.Grid.centred(size=(32, 32, 24), spacing=4.0)  # voxels and mm along (x, y, z)
cameras = mv.circular(12, 400.0, 800.0, {"pixels": [40, 48], "pixel_mm": 6.0})  # mm
A = mv.Drr(grid, cameras)
case = SCENES.build("shepp_logan").sample(0, seed=0, grid=grid, cameras=cameras)
x = case.volume[None]  # [b c d h w], d h w = (z, y, x)
y = A(x)  # [b c m v u], integrals in (unit of x) * mm
print(f"volume {tuple(x.shape)} -> views {tuple(y.shape)}")
save_png("views.png", review.mosaic(y[0, 0, :4]))

# %% [markdown]
# ## The adjoint is exact
#
# `A.T` has the same weights as A, so <A x, y> = <x, A.T y> for any x and y: here to the rounding of float64.

# %%
a = torch.rand(1, 1, *A.domain_shape, dtype=torch.float64)
b = torch.rand(1, 1, *A.range_shape, dtype=torch.float64)
left, right = (A(a) * b).sum(), (a * A.T(b)).sum()
print(f"<A a, b> = {left:.12g}, <a, A.T b> = {right:.12g}")
assert (left - right).abs() < 1e-12 * left

# %% [markdown]
# ## Gradients come with it
#
# The gradient of half the squared residual is A.T (A x - y). autograd finds the same, and one by the cameras' positions, too.

# %%
volume = torch.zeros_like(a).requires_grad_()
(0.5 * (A(volume) - b).square().sum()).backward()
assert torch.allclose(volume.grad, A.T(A(volume.detach()) - b), rtol=1e-12)

source = cameras.source.clone().requires_grad_()
moved = mv.Cameras(source, cameras.origin, cameras.u, cameras.v, cameras.shape)
mv.Drr(grid, moved)(x).square().sum().backward()
print(f"gradient by the position of source 0, for each mm: {source.grad[0].tolist()}")

# %% [markdown]
# ## Cameras know of each other
#
# What one camera sees at a pixel lies on its ray, and every other camera sees that ray as a line, the epipolar line: all that two
# views can say of each other. Points along the ray of a pixel of camera 0 are on it, in camera 2.

# %%
pixel = torch.tensor([[27.0, 16.0]], dtype=torch.float64)  # (u, v)
depths = torch.linspace(350.0, 450.0, 6, dtype=torch.float64)  # mm from the source
ray = cameras[0].unproject(torch.cat([pixel.expand(6, 2), depths[:, None]], dim=1)[None])[0]
seen = cameras[2].project(ray)[0]  # (u, v, z) of these points
line = mv.epipolar_line(cameras, 0, 2, pixel)[0]  # a u + b v + c = 0, a^2 + b^2 = 1
away = (seen[:, :2] @ line[:2] + line[2]).abs().max()
print(f"the ray's points are {away:.1e} pixels off the line")
assert away < 1e-6

figure = Figure(figsize=(7, 3), layout="constrained")
left, right = figure.subplots(1, 2)
for axes, view, name in ((left, 0, "camera 0: a pixel"), (right, 2, "camera 2: its line")):
    axes.imshow(y[0, 0, view].numpy(), cmap="gray")
    axes.set(title=name, xlabel="u, pixels", ylabel="v, pixels")
left.plot(*pixel[0].tolist(), "r+", markersize=12)
u = torch.tensor([0.0, y.shape[-1] - 1.0], dtype=torch.float64)
right.plot(u.numpy(), (-(line[0] * u + line[2]) / line[1]).numpy(), "r")
figure.savefig("epipolar.png")

# %% [markdown]
# ## What is exact, and what is an approximation
#
# A voxel is a constant cell for `siddon`: a box of ones is integrated to its chord. `joseph` interpolates, with an error of
# second order in the voxel size where the object is smooth, and of first order across edges, of which this phantom is full. The
# scene knows its own integrals, without voxels:

# %%
beam = mv.circular(1, 400.0, 800.0, {"pixels": [1, 1], "pixel_mm": 1.0})  # along an axis
length = mv.Drr(grid, beam, method="siddon")(torch.ones_like(x)).item()
print(f"a box of ones along the central ray: {length:.6f} mm; the box is {32 * 4.0} mm wide")
assert abs(length - 32 * 4.0) < 1e-3

for size, mm in ((16, 8.0), (32, 4.0), (64, 2.0)):
    fine = mv.Grid.centred(size=size, spacing=mm)
    truth = SCENES.build("shepp_logan").sample(0, seed=0, grid=fine, cameras=cameras)
    error = (mv.Drr(fine, cameras)(truth.volume[None])[0] - truth.views).norm()
    print(f"voxels of {mm} mm: views off by {error / truth.views.norm():.2%}")

# %% [markdown]
# ## Zeros cost nothing
#
# What is zero is found and left out, and the views are the same to the last bit. By default that is done where it pays; here it
# is asked for.

# %%
small = torch.zeros_like(x)
small[..., 8:16, 10:20, 12:22] = 1.0
B = mv.Drr(grid, cameras, skip="box")
assert torch.equal(B(small), mv.Drr(grid, cameras, skip="off")(small))
print(f"{B.skipped.fractions['voxels']:.1%} of the voxels were read")

# %% [markdown]
# ## Any algorithm takes any operator
#
# SIRT asks for `A` and `A.T` alone, and so takes products and parts of operators, and plugins' projectors.

# %%
volume = mv.sirt(A, y, iterations=60, momentum=True)
print(f"residual {(A(volume) - y).norm() / y.norm():.2%}")
case = review.Case("SIRT", grid, float(x.max()), "1/mm")
save_png("planes.png", review.planes(case, x[0, 0], {"SIRT": volume[0, 0]}))
