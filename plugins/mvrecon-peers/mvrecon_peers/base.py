"""Base classes of the peers: input checks, a custom torch operator, for `torch.compile`, autocast,
vmap and derivatives, adjoints by a pair of calls or by autograd, import of the libraries.
"""

import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from itertools import count
from typing import Any
from weakref import WeakValueDictionary

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.forward_ad import make_dual, unpack_dual

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.operators.checks import check, check_floating
from mvrecon.operators.memo import FixedGeometry
from mvrecon_peers.frame import framed, near, wants_gradient

CPU = torch.device("cpu")


def load(module: str, package: str, attribute: str = "") -> Any:
    """Import a library's module, or its `attribute`, on demand.

    Raises:
        ImportError: the library is not installed; the message contains the install command.
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


_PEERS: WeakValueDictionary[int, Any] = WeakValueDictionary()
_KEYS = count()


def known_by(peer: Any) -> int:
    """Register a peer under a number, by which `linear` finds it while it exists: operators do not
    accept objects.
    """
    key = next(_KEYS)
    _PEERS[key] = peer
    return key


@torch.library.custom_op("mvrecon_peers::linear", mutates_args=())
def linear(operand: Tensor, key: int, back: bool) -> Tensor:
    """Project volumes [n d h w] to views [n m v u] with a peer, or back-project."""
    peer = _PEERS[key]
    act: Callable[[Tensor], Tensor] = peer.backproject if back else peer.project
    result = operand.new_empty(operand.shape[0], *peer.sizes(back))
    with torch.autocast(operand.device.type, enabled=False):
        for one, out in zip(operand, result, strict=True):
            out.copy_(act(one.contiguous()))
    return result


@linear.register_fake
def _(operand, key, back):
    return operand.new_empty(operand.shape[0], *_PEERS[key].sizes(back))


def _keep(ctx, inputs, output):
    _, ctx.key, ctx.back = inputs
    ctx.peer = _PEERS[ctx.key]  # keeps the peer alive until backward


def _transpose(ctx, grad):
    return linear(grad, ctx.key, not ctx.back), None, None


def _mapped(info, in_dims, operand, key, back):
    moved = operand.movedim(in_dims[0], 0)
    return linear(moved.flatten(0, 1), key, back).unflatten(0, moved.shape[:2]), 0


linear.register_autograd(_transpose, setup_context=_keep)
linear.register_vmap(_mapped)


class Peer(FixedGeometry):
    """Another library's projector: [b c d h w] -> [b c m v u], in (unit of the volume) * mm.

    `box` and `rig` are the grid and the cameras in the volume's own frame, as the library receives
    them. A subclass implements `project` and `backproject` for one contiguous tensor in float32 or
    float64, without autograd.
    """

    #: Dtypes of the library; half precision becomes float32, other dtypes raise an error.
    precisions: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    #: Whether `adjoint` is the transpose of `forward`.
    matched = True
    #: Whether sums that are exact in floating point are reproduced bit for bit.
    bits = False

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__()
        self.built_from(grid, cameras)
        self.domain_shape, self.range_shape = tuple(grid.shape), (len(cameras), *cameras.shape)
        self.box, self.rig = framed(grid, cameras)
        self.key = known_by(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.key = known_by(self)

    def forward(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Project volumes one by one.

        Raises:
            TypeError: not a tensor.
            ValueError: a wrong rank or size, or a dtype or device that the library does not
                support.
            RuntimeError: see `check_unchanged`.
        """
        check(volume, "a volume [b c d h w]", self.domain_shape, getattr(volume, "device", CPU))
        return self._act(volume, "a volume", back=False)

    def adjoint(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Back-project views one by one.

        Raises:
            TypeError: see `forward`.
            ValueError: see `forward`.
        """
        check(views, "views [b c m v u]", self.range_shape, getattr(views, "device", CPU))
        return self._act(views, "views", back=True)

    def sizes(self, back: bool) -> tuple[int, ...]:
        """Trailing sizes of volumes (`back`) or of views."""
        return self.domain_shape if back else self.range_shape

    def _act(self, operand: Tensor, what: str, back: bool) -> Tensor:
        self.check_unchanged()
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
    """A library with a forward and a back-projection in main memory, outside autograd; each is the
    gradient of the other.

    Raises:
        ValueError: cameras that require a gradient, which the library does not compute.
    """

    follows_gradient = False

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
    """A torch library that defines a ray by two points. Autograd computes its gradients, including
    those of the pose.

    A subclass implements `render`. Autograd computes the matched adjoint.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__(grid, cameras)
        self._held: tuple[Tensor, Tensor] | None = None

    def _linear(self, operand: Tensor, back: bool) -> Tensor:
        """Apply as a torch operator; gradients of the pose use the library's own graph."""
        if not wants_gradient(self.cameras):
            return super()._linear(operand, back)
        act = self._transposed if back else self.project
        return torch.stack([act(one) for one in operand])

    def _rays(self, like: Tensor) -> tuple[Float[Tensor, "m r 3"], Float[Tensor, "m r 3"]]:
        """First and last points of all rays in mm in the volume's frame, with the dtype and device
        of `like`; cached if the cameras are constant.
        """
        # another thread may replace the cache
        rays = None if wants_gradient(self.cameras) else self._held
        if rays is None or rays[0].dtype != like.dtype or rays[0].device != like.device:
            _, rig = framed(self.grid, self.cameras)
            first, last = (ends.flatten(1, 2).to(like) for ends in near(self.box, *rig.rays()))
            if first.requires_grad or last.requires_grad:
                return first, last
            self._held = rays = first, last
        return rays

    def at_once(self, device: torch.device) -> int:
        """Number of views per call: on a CPU, grid_sample assigns one view to each thread."""
        return torch.get_num_threads() if device.type == "cpu" else len(self.cameras)

    def _parts(self, volume: Tensor) -> Iterator[Tensor]:
        parts = (ends.split(self.at_once(volume.device)) for ends in self._rays(volume))
        for first, last in zip(*parts, strict=True):
            yield self.render(volume, first, last).unflatten(1, self.cameras.shape)

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """The library's views."""
        return torch.cat(list(self._parts(volume)))

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """Derivative with respect to the volume, in a separate thread since autograd is disabled
        inside an operator.
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
