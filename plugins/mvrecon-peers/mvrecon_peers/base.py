"""What all peers share: the door, the adjoint's two ways, and how their libraries are loaded."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.base import check
from mvrecon_peers.frame import framed, wants_gradient

Map = Callable[[Tensor], Tensor]


def load(module: str, package: str, attribute: str = "") -> Any:
    """A library's module, or what it calls `attribute`, imported when it is needed.

    Raises:
        ImportError: there is none; the message says how to install it.
    """
    try:
        with quiet():
            found = import_module(module)
            return getattr(found, attribute) if attribute else found
    except (ImportError, AttributeError) as error:
        raise ImportError(f"This projector needs the package {package}: pip install {package} ({error})") from error


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing that a library says in here is heard."""
    with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        yield


def choice(what: str, given: str, known: tuple[str, ...]) -> str:
    """An option's value.

    Raises:
        ValueError: none of the known.
    """
    if given not in known:
        raise ValueError(f"Unknown {what} {given!r}. Known: {', '.join(known)}")
    return given


class Peer(nn.Module):
    """Another library's projector: [b c d h w] -> [b c m v u], in (unit of the volume) * mm.

    `box` and `rig` are the grid and the cameras in the volume's own frame, where the library is given them.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__()
        self.grid, self.cameras = grid, cameras
        self.box, self.rig = framed(grid, cameras)

    @property
    def T(self) -> Callable[[Float[Tensor, "b c m v u"]], Float[Tensor, "b c d h w"]]:
        """The adjoint; the class says whether it matches."""
        return self.adjoint

    def forward(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Views of volumes, one after the other.

        Raises:
            ValueError: a wrong rank or size, or a device that the library does not work on.
        """
        check(volume, "a volume [b c d h w]", self.grid.shape, volume.device)
        return self._each(self._views, volume)

    def adjoint(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from views, one after the other.

        Raises:
            ValueError: as `forward`.
        """
        check(views, "views [b c m v u]", (len(self.cameras), *self.cameras.shape), views.device)
        return self._each(self._volume, views)

    def _each(self, act: Map, tensor: Tensor) -> Tensor:
        wide = tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()
        return torch.stack([act(one) for one in wide.flatten(0, 1)]).unflatten(0, tensor.shape[:2])

    def _views(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        raise NotImplementedError

    def _volume(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        raise NotImplementedError


class Paired(Peer):
    """A library with a forward and a back projection, outside autograd: each is the other's gradient.

    A subclass gives `project` and `backproject`, which take contiguous tensors in main memory.

    Raises:
        ValueError: cameras that require a gradient, which the library does not have.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        if wants_gradient(cameras):
            who = type(self).__name__
            raise ValueError(f"{who} has no gradient in the cameras, got cameras that require one; detach them")
        super().__init__(grid, cameras)

    def _views(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        return _Linear.apply(volume, self._main(self.project), self._main(self.backproject))  # type: ignore[return-value]

    def _volume(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        return _Linear.apply(views, self._main(self.backproject), self._main(self.project))  # type: ignore[return-value]

    def _main(self, act: Map) -> Map:
        def run(tensor: Tensor) -> Tensor:
            if tensor.device.type != "cpu":
                raise ValueError(f"{type(self).__name__} works in main memory, got a tensor on {tensor.device}")
            return act(tensor.contiguous()).to(tensor.dtype)

        return run

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """The library's forward projection of one volume."""
        raise NotImplementedError

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """The library's back projection of one volume's views."""
        raise NotImplementedError


class _Linear(torch.autograd.Function):
    """y = A x, whose gradient is A^T, whose gradient is A."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, forth: Map, back: Map) -> Tensor:
        ctx.pair = forth, back
        return forth(x.detach())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, None, None]:  # type: ignore[override]
        forth, back = ctx.pair
        return _Linear.apply(grad, back, forth), None, None


class Traced(Peer):
    """A library in torch, which takes a ray as two points: its gradients, in the pose too, are autograd's.

    A subclass gives `render`. The adjoint is the matched one, by autograd.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__(grid, cameras)
        self._held: tuple[Tensor, Tensor] | None = None

    def _rays(self, like: Tensor) -> tuple[Float[Tensor, "m r 3"], Float[Tensor, "m r 3"]]:
        """First and last points of all rays in mm in the volume's frame, as `like`; made once if they stay."""
        if self._held is None or self._held[0].dtype != like.dtype or self._held[0].device != like.device:
            _, rig = framed(self.grid, self.cameras)
            first, last = (ends.flatten(1, 2).to(like) for ends in rig.rays())
            if first.requires_grad or last.requires_grad:
                return first, last
            self._held = first, last
        return self._held

    def at_once(self, device: torch.device) -> int:
        """How many views are rendered together: on a CPU, grid_sample gives each thread a view."""
        return torch.get_num_threads() if device.type == "cpu" else len(self.cameras)

    def _parts(self, volume: Tensor) -> Iterator[Tensor]:
        for first, last in zip(*(p.split(self.at_once(volume.device)) for p in self._rays(volume)), strict=True):
            yield self.render(volume, first, last).unflatten(1, self.cameras.shape)

    def _views(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        return torch.cat(list(self._parts(volume)))

    def _volume(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        graph = torch.is_grad_enabled() and (views.requires_grad or wants_gradient(self.cameras))
        with torch.enable_grad():
            x = views.new_zeros(self.grid.shape).requires_grad_()
            pairs = zip(self._parts(x), views.split(self.at_once(views.device)), strict=True)
            total = sum(torch.autograd.grad(part, x, y, create_graph=graph)[0] for part, y in pairs)
        return torch.as_tensor(total)

    def render(
        self, volume: Float[Tensor, "d h w"], first: Float[Tensor, "k r 3"], last: Float[Tensor, "k r 3"]
    ) -> Float[Tensor, "k r"]:
        """The library's integrals along rays."""
        raise NotImplementedError
