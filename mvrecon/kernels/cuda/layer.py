"""The structure of a layer's kernels; as `Layer` in `source/7_norm.cu`."""

from ctypes import c_double, c_int, c_longlong, c_void_p

from mvrecon.kernels.rays.cuda.scene import Packed


class Layer(Packed):
    """Addresses and numbers of one call; the source says what each one is."""

    _fields_ = [
        *((name, c_void_p) for name in ("features", "change", "scale", "shift")),
        *((name, c_void_p) for name in ("sums", "back", "result")),
        ("values", c_longlong),
        ("eps", c_double),
        *((name, c_int) for name in ("channels", "group", "rows", "blocks")),
    ]
