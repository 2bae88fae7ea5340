"""The compiled operators on CUDA devices: the same three as on the CPU, on torch's current stream,
without synchronisation.

Arguments are those of the operators, see `rays/ops.py`; a support may be an `Occupancy`. All
results are deterministic, as the adjoint is computed voxel by voxel, except for explicit rays,
which use atomic additions.
"""

import math
from collections.abc import Sequence
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.cuda import driver
from mvrecon.kernels.cuda.driver import BLOCK, WARP
from mvrecon.kernels.cuda.launch import NAMES, RAYS, Scene, Source, Variant, kernels_of
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.lines import JOSEPH, SIDDON, TRILINEAR, numbered
from mvrecon.kernels.rays.occupancy import Occupancy, code_size

#: Volumes that share a ray, as in `1_scene.cu`; cells copied by a thread, as in `4_project.cu`.
TOGETHER, RUN = 4, 8
#: Records of four numbers for a ray, by method, as in `5_backproject.cu`.
QUADS = {JOSEPH: 2, SIDDON: 3, TRILINEAR: 2}
#: Share of a device's memory for the rays of an adjoint.
SHARE = 1 / 16
#: Threads of a pose gradient, which splits small views over blocks.
THREADS = 2**18
#: Bytes of an occupancy's code before its box.
BOX = 3 * torch.int32.itemsize
#: Alignment in bytes of parts of a tensor, as of a tensor; bytes of a frame.
ALIGNED, FRAME = 256, 12 * torch.float32.itemsize
#: Detector rows and columns of a block.
TILE = (WARP, BLOCK // WARP)


class Call:
    """One call of an operator: its kernels, their view of the scene, and temporary tensors.

    Args:
        values: volumes [n d h w] or views [n m v u], in a type that the kernels read.
        lines: lines of the rays.
        window: valid range of a ray.
        occupancy: the non-zero part of the volume.
        detector: pixels (rows, columns).
        method: method of the rays.
        source: source of the kernels.
        together: maximum number of volumes that share a ray's index work.
    """

    def __init__(
        self,
        values: Tensor,
        lines: Float[Tensor, "m 4 3 k"],
        window: Sequence[float],
        occupancy: Occupancy,
        detector: Sequence[int],
        method: str,
        source: Source = RAYS,
        together: int = TOGETHER,
    ):
        # operations that take Python a microsecond are done once, here and below
        count, n_views, box = values.shape[0], lines.shape[0], occupancy.box
        self.device, dtype = values.device, values.dtype
        self.method, samples = numbered(method)
        self.real = torch.float64 if dtype == torch.float64 else torch.float32
        self.together = 1 if count == 1 else together
        self.groups = -(-count // self.together)
        variant = Variant(source, self.real, dtype, self.together, method.partition(":")[0])
        self.kernels = kernels_of(variant, self.device)
        self.stream = driver.stream_of(self.device)
        maps = lines.detach().double().contiguous()
        flags = self.new(1 + n_views, dtype=torch.int32, zero=True)
        self.tensors = [maps, flags]
        self.scene = source.packed(
            lines=maps.data_ptr(),
            flags=flags.data_ptr(),
            window=(float(window[0]), float(window[1])),
            sizes=occupancy.shape[::-1],
            corner=box.low[::-1],
            part=box.shape[::-1],
            n_views=n_views,
            rows=int(detector[0]),
            columns=int(detector[1]),
            maps=lines.shape[3],
            n_volumes=count,
            samples=samples,
        )

    def new(self, *shape: int, dtype: torch.dtype | None = None, zero: bool = False) -> Tensor:
        """A tensor on the device, in the type of arithmetic."""
        make = torch.zeros if zero else torch.empty
        return make(*shape, dtype=dtype or self.real, device=self.device)

    def start(self, name: str, threads: int, down: int = 1) -> None:
        """Launch a kernel with so many threads, and `down` rows of blocks."""
        across = -(-threads // BLOCK)
        driver.launch(self.kernels[name], self.scene, across, down, self.device, self.stream)

    def over_rays(self, name: str, down: int | None = None) -> None:
        """Launch a kernel with a thread a ray, in the tiles of `pixel_of`, for all groups of
        volumes, or `down` of them.
        """
        scene, (high, across) = self.scene, TILE
        if scene.rows < high or scene.columns < across:
            high = across = 1
        tiles = -(-scene.rows // high) * -(-scene.columns // across)
        self.start(name, scene.n_views * tiles * high * across, down or self.groups)

    def read(self, volume: Tensor, occupied: Tensor | None) -> None:
        """Copy the non-zero part of volumes [n d h w] to stores for the rays."""
        scene = self.scene
        ends = zip(scene.corner, scene.part, scene.sizes, strict=True)
        # with a voxel more on either side, and a border of two before and two behind
        w, h, d = (min(low + count + 1, n) - max(low - 1, 0) + 4 for low, count, n in ends)
        runs = max(-(-w // RUN) * h * d, w * -(-h // RUN) * d)
        stores = self.new(2, w * h * d * self.together * self.groups, dtype=volume.dtype)
        self.tensors += [volume, stores]
        scene.volumes, scene.stores = volume.data_ptr(), stores.data_ptr()
        if occupied is not None:
            self.tensors.append(occupied)
            scene.occupied = occupied.data_ptr() + BOX
        self.start("survey", scene.n_views)
        self.start("store", runs, 2 * self.groups)


def project(volume, lines, window, detector, method, support=None, occupied=None):
    """Line integrals of volumes [n d h w] as views [n m v u]; half precision is read directly."""
    x = stored(volume)
    call = Call(x, lines, window, Occupancy.of(x.shape[1:], support), detector, method)
    views = call.new(x.shape[0], lines.shape[0], *detector)
    call.read(x, occupied)
    call.scene.views = views.data_ptr()
    call.over_rays("project")
    return views


def backproject(views, lines, window, shape, method, support=None):
    """The exact transpose of `project`.

    Raises:
        RuntimeError: torch requires deterministic algorithms, and rays are explicit.
    """
    if lines.shape[3] == 1:
        if torch.are_deterministic_algorithms_enabled():
            raise RuntimeError(
                "The adjoint of explicit rays adds up in no fixed order on a GPU, and "
                "torch.use_deterministic_algorithms was called; it needs cameras, or backend "
                "'reference'"
            )
        return scatter(views, lines, window, shape, method, support)
    y, occupancy = to_accumulation_dtype(views).contiguous(), Occupancy.of(shape, support)
    call = Call(y, lines, window, occupancy, views.shape[2:], method)
    volume = call.new(y.shape[0], *occupancy.box.shape, zero=not lines.shape[0])
    call.scene.views, call.scene.results = y.data_ptr(), volume.data_ptr()
    _gather(call)
    return volume


def scatter(views, lines, window, shape, method, support=None):
    """`backproject` ray by ray with atomic additions, for any rays."""
    y, occupancy = to_accumulation_dtype(views).contiguous(), Occupancy.of(shape, support)
    call = Call(y, lines, window, occupancy, views.shape[2:], method)
    volume = call.new(len(y), *occupancy.box.shape, zero=True)
    call.scene.put(views=y, results=volume)
    call.over_rays("scatter")
    return volume


def _gather(call: Call) -> None:
    """Voxel by voxel, for as many views at a time as memory allows."""
    scene = call.scene
    pixels, n_views = scene.rows * scene.columns, scene.n_views
    kept = QUADS[call.method] * 4
    a_pixel = (kept + call.groups * call.together) * call.real.itemsize + 1
    at_once = max(1, int(SHARE * driver.memory_of(call.device)) // max(1, a_pixel * pixels))
    count = min(at_once, n_views) * pixels
    size = call.real.itemsize
    sizes = n_views * FRAME, count * kept * size, call.groups * count * call.together * size
    # one tensor for all, as each costs Python a microsecond: frames, rays, values, axes
    after = [0, *accumulate(-(-part // ALIGNED) * ALIGNED for part in sizes)]
    room = call.new(after[-1] + count, dtype=torch.uint8)
    first = room.data_ptr()
    scene.frames, scene.rays, scene.values, scene.axes = (first + offset for offset in after)
    call.start("survey", n_views)
    for view in range(0, n_views, at_once):
        here = min(at_once, n_views - view)
        scene.first_view, scene.views_here = view, here
        call.start("record", here * pixels, call.groups)
        call.start("gather", math.prod(scene.part), call.groups)


def lines_vjp(volume, views, lines, window, method, support=None, occupied=None):
    """The derivative of <views, project(volume, lines)> by the lines [m 4 3 k]; float64."""
    x = stored(volume)
    call = Call(x, lines, window, Occupancy.of(x.shape[1:], support), views.shape[2:], method)
    y = views.to(call.real).contiguous()
    call.read(x, occupied)
    m, maps = len(lines), lines.shape[3]
    if maps == 1:
        change = call.new(m, 1, 12, dtype=torch.float64, zero=True)
        call.scene.put(views=y, results=change)
        call.start("vary", m)
    else:
        pixels = math.prod(views.shape[2:])
        blocks = max(1, min(-(-pixels // BLOCK), THREADS // BLOCK // max(1, m)))
        change = call.new(m, blocks * BLOCK // WARP, 36, dtype=torch.float64, zero=True)
        call.scene.put(views=y, results=change, blocks_a_view=blocks)
        call.start("vary", m * blocks * BLOCK)
    return change.sum(dim=1).view(m, 4, 3, maps)


def occupied(volume, lines, window, detector, method, skip):
    """The code of the volumes' bounding box, see `Occupancy`, on their device; bricks are not
    searched on a GPU.
    """
    x = stored(volume)
    shape = list(x.shape[1:])
    code = torch.zeros(code_size(shape), dtype=torch.int32, device=x.device)
    flags = torch.zeros(6, dtype=torch.int32, device=x.device)
    part = tuple(shape[::-1])
    scene = Scene().put(volumes=x, flags=flags, occupied=code, part=part, n_volumes=len(x))
    variant = Variant(RAYS, torch.promote_types(x.dtype, torch.float32), x.dtype)
    kernels = kernels_of(variant, x.device)
    driver.launch(kernels["occupy"], scene, -(-math.prod(shape) // BLOCK), 1, x.device)
    driver.launch(kernels["bound"], scene, 1, 1, x.device)
    return code


def stored(volume: Tensor) -> Tensor:
    """Volumes in a type that the kernels read, including half precision."""
    x = volume.detach() if volume.requires_grad else volume
    return (x if x.dtype in NAMES else to_accumulation_dtype(x)).contiguous()
