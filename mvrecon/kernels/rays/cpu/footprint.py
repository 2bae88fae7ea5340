"""The pixels of a view that see a box: the half-open range in every row or column of its
detector.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mvrecon.kernels.compiling import compiled, scalar

#: Margin in pixels around the image of a box.
MARGIN = 1.0


def spans_of(
    lines: Float[np.ndarray, "m 4 3 k"],
    detector: tuple[int, int],
    tall: Bool[np.ndarray, " m"],
    boxes: Float[np.ndarray, "n 6"] | None,
) -> Int[np.ndarray, "m unit 2"]:
    """Return the pixels of every unit that may see a box.

    Args:
        lines: the views' rays.
        detector: pixels (rows, columns).
        tall: views whose units are columns; those of the others are rows.
        boxes: first and last corner (x0, y0, z0, x1, y1, z1) in voxels from the volume's centre;
            None: all pixels.
    """
    rows, columns = detector
    spans = np.zeros((len(lines), max(rows, columns), 2), np.int32)
    if boxes is None or lines.shape[3] != 3:
        spans[tall, :columns, 1] = rows
        spans[~tall, :rows, 1] = columns
        return spans
    spans[:, :, 0] = max(rows, columns)
    frames = np.zeros((len(lines), 3, 4))
    for line, frame in zip(lines, frames, strict=True):
        projection_matrix(line, frame)
    cover(frames, np.array(detector), tall, boxes, spans)
    return spans


@compiled
def cover(frames, detector, tall, boxes, spans):
    """Extend spans by the images of boxes, given the views' matrices [m 3 4]."""
    rows, columns = detector
    for m in range(len(frames)):
        frame = frames[m]
        for n in range(len(boxes)):
            u0 = v0 = np.inf
            u1 = v1 = -np.inf
            side = 0
            for corner in range(8):
                i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
                x, y, z = boxes[n, 3 * i], boxes[n, 1 + 3 * j], boxes[n, 2 + 3 * k]
                w = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3]
                reach = (
                    abs(frame[2, 0] * x)
                    + abs(frame[2, 1] * y)
                    + abs(frame[2, 2] * z)
                    + abs(frame[2, 3])
                )
                if abs(w) > 1e-9 * reach:
                    side += 1 if w > 0 else -1
                    u = (frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3]) / w
                    v = (frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3]) / w
                    u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
            if abs(side) < 8:  # the source's plane cuts the box: its image is unbounded
                u0 = v0 = -np.inf
                u1 = v1 = np.inf
            first_u, last_u = _pixels(u0, u1, columns)
            first_v, last_v = _pixels(v0, v1, rows)
            if first_u >= last_u or first_v >= last_v:
                continue
            if tall[m]:
                for u in range(first_u, last_u):
                    spans[m, u, 0], spans[m, u, 1] = (
                        min(spans[m, u, 0], first_v),
                        max(spans[m, u, 1], last_v),
                    )
            else:
                for v in range(first_v, last_v):
                    spans[m, v, 0], spans[m, v, 1] = (
                        min(spans[m, v, 0], first_u),
                        max(spans[m, v, 1], last_u),
                    )


@compiled
def _pixels(low, high, count):
    centre = (count - 1) / 2
    first = min(max(np.ceil(low + centre - MARGIN), 0.0), float(count))
    last = min(max(np.floor(high + centre + MARGIN) + 1, 0.0), float(count))
    return int(first), int(last)


@scalar
def cross(matrix, one, two, axis):
    """A component of the cross product of two columns (kind, column) of a view's maps."""
    p, q = (axis + 1) % 3, (axis + 2) % 3
    return (
        matrix[one[0], p, one[1]] * matrix[two[0], q, two[1]]
        - matrix[one[0], q, one[1]] * matrix[two[0], p, two[1]]
    )


@compiled
def projection_matrix(line, into):
    """Write the matrix [3 4] that maps points (x, y, z, 1) to pixels (u, v, 1) of a view up to a
    factor.

    It solves source + w (U u + V v + A) = X, for parallel beams O + U u + V v + w A = X (Cramer's
    rule). Zero for explicit rays, and for coplanar U, V and A.
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
