"""A view's matrix [3 4]: from points in voxel space to pixels, the inverse of its lines."""

from mvrecon.kernels.compiling import scalar


@scalar
def cross(matrix, one, two, axis):
    """A component of the cross product of two columns (kind, column) of a view's maps."""
    p, q = (axis + 1) % 3, (axis + 2) % 3
    return (
        matrix[one[0], p, one[1]] * matrix[two[0], q, two[1]]
        - matrix[one[0], q, one[1]] * matrix[two[0], p, two[1]]
    )


@scalar
def projection_matrix(line, into):
    """Write the matrix [3 4] that takes points (x, y, z, 1) of a view to pixels (u, v, 1) up to a
    factor.

    It solves source + w (U u + V v + A) = X, for parallel beams O + U u + V v + w A = X (Cramer's
    rule). For explicit rays, and where U, V and A lie in one plane, it takes everything to (0, 0,
    0).
    """
    into[:] = 0
    if line.shape[2] == 1:
        return
    parallel = True
    for axis in range(3):
        parallel = parallel and line[0, axis, 0] == 0 and line[0, axis, 1] == 0
    kind = 2 if parallel else 0
    U, V, A = (kind, 0), (kind, 1), (0, 2)
    scale = 0.0
    for axis in range(3):
        into[0, axis], into[1, axis] = cross(line, V, A, axis), cross(line, A, U, axis)
        if parallel:
            into[2, 3] += cross(line, V, A, axis) * line[kind, axis, 0]
        else:
            into[2, axis] = cross(line, U, V, axis)
        start = line[2, axis, 2]
        into[0, 3] -= into[0, axis] * start
        into[1, 3] -= into[1, axis] * start
        into[2, 3] -= into[2, axis] * start
        scale += abs(into[2, axis])
    scale += abs(into[2, 3])
    for row in range(3):
        for column in range(4):
            into[row, column] = into[row, column] / scale if scale > 0 else 0.0
