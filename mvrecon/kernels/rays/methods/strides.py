"""Flat indices of voxels in padded volumes, see `padding.py`, in any layout."""

from typing import Any, NamedTuple

from mvrecon.kernels.compiling import scalar


class Steps(NamedTuple):
    """Flat strides along the ray's main, far and near axis; samples a ray; how far the box's first
    voxel lies behind the volume's in a store of the box alone.
    """

    along: Any
    far: Any
    near: Any
    samples: Any
    origin: Any


@scalar
def flat_index(steps, k, iy, iz, whole):
    """The flat index of a voxel, of type `whole`: slab k counted from the volume, the others from
    its padding.
    """
    slab, row = whole(whole(k + 1) * whole(steps.along)), whole(whole(iy) * whole(steps.far))
    return whole(
        whole(whole(slab + row) + whole(whole(iz) * whole(steps.near))) - whole(steps.origin)
    )
