"""Base classes of the peers: checks of the input, adjoint by a pair of calls or by autograd,
loading of libraries.
"""

import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.forward_ad import make_dual, unpack_dual

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.operators.operator import Projector, check, check_floating
from mvrecon_peers.frame import framed, near, wants_gradient
from mvrecon_peers.operator import known_by, linear

CPU = torch.device("cpu")


def load(module: str, package: str, attribute: str = "") -> Any:
    """A library's module, or what it calls `attribute`, imported when it is needed.

    Raises:
        ImportError: there is none; the message says how to install it.
    """
    try:
        with quiet():
            library = import_module(module)
            return getattr(library, attribute) if attribute else library
    except (ImportError, AttributeError) as error:
        raise ImportError(
            f"This projector needs the package {package}: pip install {package} ({error})"
        ) from error


@contextmanager
def quiet() -> Iterator[None]:
    """Context that silences the output of a library."""
    with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        yield


def choice(what: str, value: str, known: tuple[str, ...]) -> str:
    """An option's value.

    Raises:
        ValueError: none of the known.
    """
    if value not in known:
        raise ValueError(f"Unknown {what} {value!r}. Known: {', '.join(known)}")
    return value


class Peer(Projector):
    """Another library's projector: [b c d h w] -> [b c m v u], in (unit of the volume) * mm.

    `box` and `rig` are the grid and the cameras in the volume's own frame, where the library is
    given them. A subclass gives `project` and `backproject`, which take one contiguous tensor in
    float32 or float64, without a graph.
    """

    #: What the library computes in; halves become float32, anything else is refused.
    precisions: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    #: Whether `adjoint` is the transpose of `forward`.
    matched = True
    #: Whether sums that are exact in floating point are so to the last bit.
    bits = False

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__()
        self.grid, self.cameras = grid, cameras
        self.domain_shape, self.range_shape = tuple(grid.shape), (len(cameras), *cameras.shape)
        self.box, self.rig = framed(grid, cameras)
        self.key = known_by(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.key = known_by(self)

    def forward(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Views of volumes, one after the other.

        Raises:
            TypeError: no tensor.
            ValueError: a wrong rank or size, or a dtype or a device that the library does not work
                in.
        """
        check(volume, "a volume [b c d h w]", self.domain_shape, getattr(volume, "device", CPU))
        return self._act(volume, "a volume", back=False)

    def adjoint(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from views, one after the other.

        Raises:
            TypeError: as `forward`.
            ValueError: as `forward`.
        """
        check(views, "views [b c m v u]", self.range_shape, getattr(views, "device", CPU))
        return self._act(views, "views", back=True)

    def sizes(self, back: bool) -> tuple[int, ...]:
        """The last sizes of volumes (back) or of views."""
        return self.domain_shape if back else self.range_shape

    def _act(self, operand: Tensor, what: str, back: bool) -> Tensor:
        check_floating(operand, what)
        operand = to_accumulation_dtype(operand)
        if operand.dtype not in self.precisions:
            names = " or ".join(str(dtype) for dtype in self.precisions)
            raise ValueError(
                f"{type(self).__name__} computes in {names}, got {what} of {operand.dtype}"
            )
        primal, tangent = unpack_dual(operand)
        if tangent is not None:
            return make_dual(self._act(primal, what, back), self._act(tangent, what, back))
        return self._linear(operand.flatten(0, 1), back).unflatten(0, operand.shape[:2])

    def _linear(self, operand: Tensor, back: bool) -> Tensor:
        return linear(operand, self.key, back)

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """The library's forward projection of one volume."""
        raise NotImplementedError

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """The library's back projection of one volume's views."""
        raise NotImplementedError


class Paired(Peer):
    """A library with a forward and a back projection, outside autograd, in main memory: each is the
    other's gradient.

    Raises:
        ValueError: cameras that require a gradient, which the library does not have.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        if wants_gradient(cameras):
            who = type(self).__name__
            raise ValueError(
                f"{who} has no gradient in the cameras, got cameras that require one; detach them"
            )
        super().__init__(grid, cameras)

    def _act(self, operand: Tensor, what: str, back: bool) -> Tensor:
        if operand.device.type != "cpu":
            raise ValueError(
                f"{type(self).__name__} works in main memory, got a tensor on {operand.device}"
            )
        return super()._act(operand, what, back)


class Traced(Peer):
    """A library in torch, which takes a ray as two points: its gradients, in the pose too, are
    autograd's.

    A subclass gives `render`. The adjoint is the matched one, by autograd.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__(grid, cameras)
        self._held: tuple[Tensor, Tensor] | None = None

    def _linear(self, operand: Tensor, back: bool) -> Tensor:
        """A torch operator; for gradients in the pose the library's own graph."""
        if not wants_gradient(self.cameras):
            return super()._linear(operand, back)
        act = self._transposed if back else self.project
        return torch.stack([act(one) for one in operand])

    def _rays(self, like: Tensor) -> tuple[Float[Tensor, "m r 3"], Float[Tensor, "m r 3"]]:
        """First and last points of all rays in mm in the volume's frame, as `like`; made once if
        they stay.
        """
        rays = self._held  # another thread may replace it
        if rays is None or rays[0].dtype != like.dtype or rays[0].device != like.device:
            _, rig = framed(self.grid, self.cameras)
            first, last = (ends.flatten(1, 2).to(like) for ends in near(self.box, *rig.rays()))
            if first.requires_grad or last.requires_grad:
                return first, last
            self._held = rays = first, last
        return rays

    def at_once(self, device: torch.device) -> int:
        """How many views are rendered together: on a CPU, grid_sample gives each thread a view."""
        return torch.get_num_threads() if device.type == "cpu" else len(self.cameras)

    def _parts(self, volume: Tensor) -> Iterator[Tensor]:
        for first, last in zip(
            *(p.split(self.at_once(volume.device)) for p in self._rays(volume)), strict=True
        ):
            yield self.render(volume, first, last).unflatten(1, self.cameras.shape)

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """The library's views."""
        return torch.cat(list(self._parts(volume)))

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """Their derivative by the volume; in a thread of its own, since autograd sleeps inside of
        an operator.
        """
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(self._transposed, views).result()

    def _transposed(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        graph = torch.is_grad_enabled() and (views.requires_grad or wants_gradient(self.cameras))
        with torch.enable_grad():
            x = views.new_zeros(self.grid.shape).requires_grad_()
            pairs = zip(self._parts(x), views.split(self.at_once(views.device)), strict=True)
            total = sum(torch.autograd.grad(part, x, y, create_graph=graph)[0] for part, y in pairs)
        return torch.as_tensor(total)

    def render(
        self,
        volume: Float[Tensor, "d h w"],
        first: Float[Tensor, "k r 3"],
        last: Float[Tensor, "k r 3"],
    ) -> Float[Tensor, "k r"]:
        """The library's integrals along rays."""
        raise NotImplementedError
