# %% [markdown]
# # Your own plugin
#
# A plugin brings parts by name: projectors, heads, scenes and others. `mvrecon-list --new-plugin my_plugin` writes a project to
# start from, with one part of every kind; this is what that command calls.

# %%
import sys
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.apps.list import new_plugin
from mvrecon.core.parts import HEADS, PROJECTORS
from mvrecon.methods.learned.cross_view import CrossView
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.operators.operator import Wrapped
from mvrecon.testing import check_head, check_projector

for file in new_plugin("my_plugin", Path.cwd()):
    print(file.relative_to(Path.cwd()))

# %% [markdown]
# `pip install -e my_plugin` makes its parts known. Without installing, Python's path and a registration do:

# %%
sys.path.insert(0, str(Path("my_plugin").absolute()))
from my_plugin.projector import sensitive

print(Path("my_plugin/my_plugin/projector.py").read_text())
PROJECTORS.register("my_projector")(sensitive)

# %% [markdown]
# ## A projector
#
# Now one of our own: line integrals that the detector blurs along its rows. Only the blur is new, so it wraps `Drr`; `adjoint`
# must be the exact transpose. The blur is symmetric, and so is its own transpose. `pixelwise = False` declares for the stress plan that
# a pixel depends on its neighbours.


# %%
@PROJECTORS.register("my_blur")
class Blurred(Wrapped):
    """Line integrals in (unit of the volume) mm, a share of each pixel in either neighbour.

    Args:
        grid: of the volume.
        cameras: the rig.
        share: of a pixel's value that each neighbour along u gets.
    """

    pixelwise = False

    def __init__(self, grid, cameras, share: float = 0.25):
        super().__init__(mv.Drr(grid, cameras))
        self.share = share

    def blurred(self, y):
        left, right = torch.zeros_like(y), torch.zeros_like(y)
        left[..., 1:], right[..., :-1] = y[..., :-1], y[..., 1:]
        return (1 - 2 * self.share) * y + self.share * (left + right)

    def forward(self, x):
        return self.blurred(self.A(x))

    def adjoint(self, y):
        return self.A.T(self.blurred(y))


# %% [markdown]
# `check_projector` tests the contract of projectors: shapes, the transpose, linearity, gradients, supports.

# %%
small = mv.Grid.centred(size=(3, 4, 3), spacing=(1.0, 1.2, 0.9))
plate = {
    "pixels": [3, 2],
    "pixel_mm": 2.1,
    "offset_mm": [0.4, -0.3],
}  # a pose where nothing is aligned
two = mv.circular(2, 40.0, 70.0, plate, start_degrees=13.0)
for name in ("my_projector", "my_blur"):
    check_projector(name, small, two, gradients=name == "my_blur")
    print(f"{name}: keeps the contract")


# %% [markdown]
# ## A head
#
# A head makes a camera's density along its rays from a network's logits. This one is sharper than `softmax_depth`: the softmax of
# twice the logits, times the measured integral.


# %%
@HEADS.register("my_head")
class Sharp(torch.nn.Module):
    """Depths by the softmax of twice the logits; its volume reproduces its own view."""

    keeps_views = True

    def forward(self, logits, prior, views, frusta):
        return HEADS.build("softmax_depth")(2 * logits, prior, views, frusta)


grid = mv.Grid.centred(12, spacing=4.0)
A = PROJECTORS.build(
    "my_blur",
    grid=grid,
    cameras=mv.circular(3, 200.0, 400.0, {"pixels": [15, 15], "pixel_mm": 8.0}),
)
check_head("my_head", Frusta.of(grid, A.cameras, depth=12))
method = CrossView(head="my_head", widths=[4, 8], depth_widths=[4], scale=1)
views = A(torch.rand(1, 1, *grid.shape))
print(f"a method with both: {tuple(method(views, A).volume.shape)}")

# %% [markdown]
# In a project the names come from its `pyproject.toml`, options from its `conf`, and
# `mvrecon-train experiment=smoke projector.name=my_blur plugins=[my_parts]` trains with a module that is not installed:
# [plugins/README.md](../../plugins/README.md).
