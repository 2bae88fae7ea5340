"""The structure that every kernel is launched with; as `Scene` in `source/1_scene.cu`."""

import ctypes
from ctypes import c_double, c_int, c_void_p
from typing import Any, Self

from torch import Tensor


class Packed(ctypes.Structure):
    """Addresses and numbers of one call."""

    def put(self, **values: Any) -> Self:
        """Write some fields: tensors as their addresses, sequences as arrays."""
        for name, value in values.items():
            if isinstance(value, Tensor):
                setattr(self, name, value.data_ptr())
            elif isinstance(value, tuple):
                getattr(self, name)[:] = value
            else:
                setattr(self, name, value)
        return self


class Scene(Packed):
    """Addresses and numbers of a call along rays; the source says what each one is."""

    _fields_ = [
        *((name, c_void_p) for name in ("lines", "volumes", "stores", "views", "rays", "axes")),
        *((name, c_void_p) for name in ("values", "frames", "flags", "results", "occupied")),
        ("layers", c_void_p),
        ("fixed", c_double),
        ("window", c_double * 2),
        *((name, c_int * 3) for name in ("sizes", "corner", "part")),
        *((name, c_int) for name in ("n_views", "rows", "columns", "maps", "n_volumes")),
        *((name, c_int) for name in ("samples", "first_view", "views_here", "blocks_a_view")),
        ("n_layers", c_int),
    ]
