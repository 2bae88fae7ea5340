"""Columns of `results.csv`: meaning and unit of each, by benchmark."""

from collections.abc import Mapping

MEDIAN = "median of at least `repeats` calls"
#: Columns of several benchmarks.
SHARED = {
    "part": "projector or method, by its name in the registry",
    "method": "option of a projector of that name, where it has one",
    "options": "all options of the part, as JSON",
    "backend": "implementation, if reported: cpu, cuda, reference, or another library's own",
    "device": "of volumes and views",
    "dtype": "of volume and views in memory; the arithmetic of float16 and bfloat16 is the part's",
    "threads": "threads of torch",
    "scene": "the object, with integrals in closed form",
    "camera": "the rig",
    "n": "voxels along each edge of the volume",
    "ratio": "pixel / voxel, both at the isocentre",
    "views": "number of cameras",
    "pixels": "rows, and columns, of each detector",
    "status": "ok, or skipped: and the reason",
    "note": "failed calls, and calls too slow to repeat",
    "forward_ms": f"y = A x, in ms: {MEDIAN} after the first, launch included",
    "adjoint_ms": "A^T y, in ms, likewise",
    "ms": f"one call in ms: {MEDIAN}, timed alternately with the other rows of the case",
    "calls": "number of calls for a median, the smallest of several",
    "peak_mb": "peak memory of a call in 2^20 bytes, with its result, above that in use before",
    "load": "the machine's load average over the minute before",
}


def table(names: str, **others: str) -> Mapping[str, str]:
    """Name -> meaning, of shared columns and of a benchmark's own."""
    return {name: others.get(name) or SHARED[name] for name in names.split()}


OPERATORS = table(
    "part method options backend device dtype threads scene camera n ratio views pixels rays status"
    " note error_thin error_pixel floor_thin floor_pixel forward_ms adjoint_ms volume_grad_ms"
    " pose_grad_ms first_ms calls peak_mb adjoint_peak_mb adjointness repeatable nans pose_cosine"
    " load",
    pixels="rows x columns of each detector",
    rays="views x pixels",
    error_thin="|A x - t| / |t| over all pixels, t the exact integrals along their central rays",
    error_pixel="the same, t the mean of exact integrals along rays x rays lines to a pixel",
    floor_thin="error_thin of the exact integrals of the same voxels (Siddon in float64)",
    floor_pixel="error_pixel of the same integrals; interpolating methods may err less",
    volume_grad_ms="forward and backward to the volume, in ms, likewise",
    pose_grad_ms="forward and backward to the cameras, in ms, likewise",
    first_ms="the first forward call in ms, with compilation and loading of kernels",
    adjoint_peak_mb="peak_mb of an adjoint call",
    adjointness="|<A x, y> - <x, A^T y>| / (|A x| |y|) for random x and y",
    repeatable="whether two calls of forward and adjoint are bitwise equal",
    nans="values that are NaN or infinite in views, adjoint and both gradients",
    pose_cosine="cosine between the derivatives of sum(w y) by rigid motions of up to four cameras "
    "and those of the closed form, averaged over 2 x 2 rays to a pixel; w is white noise",
)
SCALING = table(
    "part method options backend device dtype axis size n pixels views batch channels threads"
    " status note forward_ms adjoint_ms calls load",
    axis="the varied quantity: voxels, rays (of each view), views, batch, channels or threads",
    size="its value: n^3, pixels^2, or a count",
    batch="volumes on the same rays",
    channels="of each volume",
)
METHODS = table(
    "part options scene camera n slices ratio views device dtype threads status error ms"
    " peak_mb peer over_peer calls load",
    slices="voxels along z; 0: n",
    error="|x - t| / |t| over the voxels of the object, t the mean of the phantom in each voxel",
    peer="the part for `over_peer`",
    over_peer="ms / that of the peer",
)
SKIP = table(
    "scene source rig method task mode n device threads grid views status chosen why occupancy box"
    " support ms over_full over_crop build_ms error differing peak_mb calls load",
    scene="the object, by its name in the configuration",
    source="of its volume: a phantom, a case of a file, or a substitute",
    rig="the cameras, by their name in the configuration",
    task="forward: A x of a new volume at every call; forward_static: A x, the support given once; "
    "adjoint: A^T y inside the support, given once, y white noise; sirt20: 20 iterations of SIRT "
    "inside the hull of the views",
    mode="off: nothing is skipped; cropped: nothing, on the volume cropped to the box of its "
    "non-zero voxels; others: `skip` of the projector",
    grid="voxels along z, y, x of the whole volume",
    views="cameras x rows x columns",
    chosen="what the last call skipped, as the operator reports",
    why="reason for that choice",
    occupancy="share of non-zero voxels",
    box="share of the volume in the box around them",
    support="share of the voxels in the hull of the views, of sirt20",
    over_full="speed relative to off: its ms / ms; ms includes building the mask, except for "
    "forward_static, adjoint, off and cropped",
    over_crop="speed relative to cropped: its ms / ms",
    build_ms="building the mask, in ms; blank if every call builds its own",
    error="greatest absolute difference from off; of the adjoint inside the support",
    differing="number of values that are not bitwise equal to those of off",
)
PRECISION = table(
    "task precision n device threads status error not_finite ms ratio peak_mb calls load",
    task="the computation",
    precision="storage of volumes and views",
    error="|y - t| / |t|, t in float64 from unrounded operands",
    not_finite="values that are NaN or infinite",
    ratio="ms / that of float32",
)
EMISSION = table(
    "model method n pixels status cpu_s over_plain load",
    model="of the projector spect: plain, attenuated, blur, or both",
    pixels="along each edge of 80 detectors",
    cpu_s="processor seconds of an iteration of MLEM, A x and A^T y, with one thread: "
    f"{MEDIAN}, timed alternately with the other models",
    over_plain="cpu_s / that of plain footprints",
)
