"""Bilinear values on a plane of padded, flat samples; two planes make a trilinear cell."""

from mvrecon.kernels.compiling import scalar


@scalar
def face(flat, across):
    """A plane as seen from the four corners of its cells, so that one index serves all."""
    return flat, flat[1:], flat[across:], flat[across + 1 :]


@scalar
def bilinear(face, k, x, y):
    """The value in cell k."""
    near, far = (
        face[0][k] + x * (face[1][k] - face[0][k]),
        face[2][k] + x * (face[3][k] - face[2][k]),
    )
    return near + y * (far - near)


@scalar
def lay(face, k, x, y, value):
    """Add a value to the corners of cell k with the weights of `bilinear`."""
    far = y * value
    near = value - far
    near_x, far_x = x * near, x * far
    face[0][k] += near - near_x
    face[1][k] += near_x
    face[2][k] += far - far_x
    face[3][k] += far_x
