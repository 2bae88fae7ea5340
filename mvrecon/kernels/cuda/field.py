"""The structure that these kernels are launched with; as `Field` in `source/1_field.cu`."""

from ctypes import c_double, c_int, c_void_p

from mvrecon.kernels.rays.cuda.scene import Packed


class Field(Packed):
    """Addresses and numbers of one call; the source says what each one is."""

    _fields_ = [
        *((name, c_void_p) for name in ("maps", "inverse", "origin", "by", "result")),
        ("window", c_double * 2),
        *((name, c_int * 3) for name in ("source", "shape")),
        *((name, c_int) for name in ("sources", "kinds", "items", "channels")),
        *((name, c_int) for name in ("blocks", "weighted")),
        ("voxels", c_int * 3),
        *((name, c_int) for name in ("edge", "enough", "keep_unseen", "parallel")),
        ("reach", c_double),
    ]
