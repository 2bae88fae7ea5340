"""The compiled operators of CUDA devices: the same three as those of the CPU, on torch's current
stream, without a wait.

Everything is the same to the last bit in every run: the adjoint goes voxel by voxel. Rays given one
by one alone spread with atomic additions, in no fixed order.
"""

import math
from collections.abc import Sequence
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.precision import wide
from mvrecon.kernels.rays.cuda import driver
from mvrecon.kernels.rays.cuda.kernels import kernels_of
from mvrecon.kernels.rays.cuda.scene import Scene
from mvrecon.kernels.rays.cuda.sources import BLOCK, NAMES, QUADS, RUN, TOGETHER, WARP, Variant
from mvrecon.kernels.rays.occupancy import Occupancy, code_size
from mvrecon.kernels.rays.trace import numbered

#: The part of a device's memory that the rays of an adjoint may take.
SHARE = 1 / 16
#: Threads of a pose gradient, so that a small view is split over blocks.
THREADS = 2**18
#: Bytes of an occupancy's code in front of its box.
BOX = 3 * torch.int32.itemsize
#: Bytes that a part of a tensor begins at a multiple of, as a tensor of its own does; of a frame.
ALIGNED, FRAME = 256, 12 * torch.float32.itemsize
#: Detector rows and columns that a block takes.
TILE = (WARP, BLOCK // WARP)


class Call:
    """One call of an operator: its kernels, what they know of the scene, and tensors they use.

    Args:
        values: volumes [n d h w] or views [n m v u], in a type that the kernels read.
        lines: of the rays.
        window: the part of a ray that counts.
        occupancy: the part of the volume that there is.
        detector: pixels (rows, columns).
        method: of the rays.
        attenuated: whether kernels are those of attenuated rays, a volume at a time.
    """

    def __init__(
        self,
        values: Tensor,
        lines: Float[Tensor, "m 4 3 k"],
        window: Sequence[float],
        occupancy: Occupancy,
        detector: Sequence[int],
        method: str,
        attenuated: bool = False,
    ):
        # what costs Python a microsecond is asked for once, here and below
        count, n_views, box = values.shape[0], lines.shape[0], occupancy.box
        self.device, dtype = values.device, values.dtype
        self.method, samples = numbered(method)
        self.real = torch.float64 if dtype == torch.float64 else torch.float32
        self.together = 1 if count == 1 or attenuated else TOGETHER
        self.groups = -(-count // self.together)
        variant = Variant(self.real, dtype, self.together, self.method, attenuated)
        self.kernels = kernels_of(variant, self.device)
        self.stream = driver.stream_of(self.device)
        maps = lines.detach().double().contiguous()
        flags = self.new(1 + n_views, dtype=torch.int32, zero=True)
        self.tensors = [maps, flags]
        self.scene = Scene(
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
        """Launch a kernel with so many threads, and blocks downwards."""
        across = -(-threads // BLOCK)
        driver.launch(self.kernels[name], self.scene, across, down, self.device, self.stream)

    def over_rays(self, name: str, down: int | None = None) -> None:
        """Launch a kernel with a thread a ray, tile by tile, as `pixel_of` counts them, for all
        groups of volumes, or `down` of them.
        """
        scene, (high, across) = self.scene, TILE
        if scene.rows < high or scene.columns < across:
            high = across = 1
        tiles = -(-scene.rows // high) * -(-scene.columns // across)
        self.start(name, scene.n_views * tiles * high * across, down or self.groups)

    def read(self, volume: Tensor, occupied: Tensor | None) -> None:
        """Copy volumes [n d h w] of the part that there is to where rays read them."""
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


def project(
    volume: Float[Tensor, "n d h w"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    occupancy: Occupancy,
    detector: Sequence[int],
    method: str,
    occupied: Tensor | None = None,
) -> Float[Tensor, "n m v u"]:
    """Line integrals of volumes, in mm times their unit; see `reference.project`.

    Args:
        volume: the part that `occupancy` says there is; half volumes are read as they are.
        occupied: the code of an occupancy on the device, outside of whose box volumes are zero.
    """
    x = stored(volume)
    call = Call(x, lines, window, occupancy, detector, method)
    views = call.new(x.shape[0], lines.shape[0], *detector)
    call.read(x, occupied)
    call.scene.views = views.data_ptr()
    call.over_rays("project")
    return views


def backproject(
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    occupancy: Occupancy,
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project`.

    Raises:
        RuntimeError: torch is to use deterministic algorithms alone, and rays are given one by one.
    """
    if lines.shape[3] == 1:
        if torch.are_deterministic_algorithms_enabled():
            raise RuntimeError(
                "The adjoint of explicit rays adds up in no fixed order on a GPU, and "
                "torch.use_deterministic_algorithms was called; it needs cameras, or backend "
                "'reference'"
            )
        return scatter(views, lines, window, occupancy, method)
    y = wide(views).contiguous()
    call = Call(y, lines, window, occupancy, views.shape[2:], method)
    volume = call.new(y.shape[0], *occupancy.box.shape, zero=not lines.shape[0])
    call.scene.views, call.scene.results = y.data_ptr(), volume.data_ptr()
    _gather(call)
    return volume


def scatter(
    views: Tensor, lines: Tensor, window: Sequence[float], occupancy: Occupancy, method: str
) -> Float[Tensor, "n d h w"]:
    """`backproject` ray by ray, with atomic additions: of any rays."""
    y = wide(views).contiguous()
    call = Call(y, lines, window, occupancy, views.shape[2:], method)
    volume = call.new(len(y), *occupancy.box.shape, zero=True)
    call.scene.put(views=y, results=volume)
    call.over_rays("scatter")
    return volume


def _gather(call: Call) -> None:
    """Voxel by voxel, for as many views at a time as there is memory for their rays."""
    scene = call.scene
    pixels, n_views = scene.rows * scene.columns, scene.n_views
    kept = QUADS[call.method] * 4
    a_pixel = (kept + call.groups * call.together) * call.real.itemsize + 1
    at_once = max(1, int(SHARE * driver.memory_of(call.device)) // max(1, a_pixel * pixels))
    count = min(at_once, n_views) * pixels
    size = call.real.itemsize
    sizes = n_views * FRAME, count * kept * size, call.groups * count * call.together * size
    # one tensor for all, since each costs Python a microsecond: frames, rays, values, axes
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


def lines_vjp(
    volume: Float[Tensor, "n d h w"],
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    occupancy: Occupancy,
    method: str,
    occupied: Tensor | None = None,
) -> Float[Tensor, "m 4 3 k"]:
    """The derivative of <views, project(volume, lines)> by the lines; float64."""
    x = stored(volume)
    call = Call(x, lines, window, occupancy, views.shape[2:], method)
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


def occupied_code(volume: Float[Tensor, "n d h w"]) -> Tensor:
    """The code of the box outside of which volumes are zero, see `Occupancy`, on their device."""
    x = stored(volume)
    shape = list(x.shape[1:])
    code = torch.zeros(code_size(shape), dtype=torch.int32, device=x.device)
    flags = torch.zeros(6, dtype=torch.int32, device=x.device)
    part = tuple(shape[::-1])
    scene = Scene().put(volumes=x, flags=flags, occupied=code, part=part, n_volumes=len(x))
    kernels = kernels_of(
        Variant(torch.promote_types(x.dtype, torch.float32), x.dtype, 1, 0), x.device
    )
    driver.launch(kernels["occupy"], scene, -(-math.prod(shape) // BLOCK), 1, x.device)
    driver.launch(kernels["bound"], scene, 1, 1, x.device)
    return code


def stored(volume: Tensor) -> Tensor:
    """Volumes as the kernels read them: half precision as such."""
    x = volume.detach() if volume.requires_grad else volume
    return (x if x.dtype in NAMES else wide(x)).contiguous()
