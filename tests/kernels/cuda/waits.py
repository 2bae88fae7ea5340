"""What would wait for a device."""

from torch.utils._python_dispatch import TorchDispatchMode


class Waits(TorchDispatchMode):
    """Names of the operations that would wait for a device."""

    ASKED = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2"}

    def __init__(self):
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        copied = name == "_to_copy" and "device" in (kwargs or {})
        if name in self.ASKED or (copied and not (kwargs or {}).get("non_blocking")):
            self.names.append(name)
        return func(*args, **(kwargs or {}))
