"""Columns of `results.csv`: meaning and unit of each."""

KEYS = ("part", "options", "device", "dtype", "threads", "scene", "camera", "n", "ratio", "views")

#: `bench=operators`.
OPERATORS = {
    "part": "projector, by its name in the registry",
    "method": "its option of that name, where it has one",
    "options": "all its options, as JSON",
    "backend": "implementation, if reported: cpu, cuda, reference, or another library's own",
    "device": "of volume and views",
    "dtype": "of volume and views in memory; the arithmetic of float16 and bfloat16 is the part's",
    "threads": "threads of torch",
    "scene": "the object, with integrals in closed form",
    "camera": "the rig",
    "n": "voxels along each edge of the volume",
    "ratio": "pixel / voxel, both at the isocentre",
    "views": "number of cameras",
    "pixels": "rows x columns of each detector",
    "rays": "views x pixels",
    "status": "ok, or skipped: and the reason",
    "note": "failed calls, and calls too slow to repeat",
    "error_thin": "|A x - t| / |t| over all pixels, t the exact integrals along the pixels' "
    "central rays",
    "error_pixel": "the same, t the mean of exact integrals along rays x rays lines to a pixel",
    "floor_thin": "error_thin of the exact integrals of the same voxels (Siddon in float64)",
    "floor_pixel": "error_pixel of the same integrals; interpolating methods may err less",
    "forward_ms": "y = A x, in ms: median of at least `repeats` calls after the first, launch "
    "included",
    "adjoint_ms": "A^T y, in ms, likewise",
    "volume_grad_ms": "forward and backward to the volume, in ms, likewise",
    "pose_grad_ms": "forward and backward to the cameras, in ms, likewise",
    "first_ms": "the first forward call in ms, with compilation and loading of kernels",
    "calls": "number of calls for a median, the smallest of the four times",
    "forward_ratio": "forward_ms / that of the first part of the list, timed alternately",
    "adjoint_ratio": "adjoint_ms / that of the first part, likewise",
    "volume_grad_ratio": "volume_grad_ms / that of the first part, likewise",
    "pose_grad_ratio": "pose_grad_ms / that of the first part, likewise",
    "peak_mb": "peak memory of a forward call in 2^20 bytes, with its output, above that in use "
    "before",
    "adjoint_peak_mb": "the same of an adjoint call",
    "ray_slabs_per_s": "rays x n / forward time; nominal, as if nothing were skipped",
    "adjointness": "|<A x, y> - <x, A^T y>| / (|A x| |y|) for random x and y",
    "repeatable": "whether two calls of forward and adjoint are bitwise equal",
    "nans": "values that are NaN or infinite in views, adjoint and both gradients",
    "pose_cosine": "cosine between the derivatives of sum(w y) by rigid motions of up to four "
    "cameras and those of the "
    "closed form, averaged over 2 x 2 rays to a pixel; w is white noise",
    "load": "the machine's load average over the minute before",
}

SCALING_KEYS = (
    *("part", "options", "device", "dtype", "axis"),
    *("n", "pixels", "views", "batch", "channels", "threads"),
)

#: `bench=scaling`.
SCALING = {
    **{
        name: OPERATORS[name]
        for name in ("part", "method", "options", "backend", "device", "dtype")
    },
    "axis": "the varied quantity: voxels, rays (of each view), views, batch, channels or threads",
    "size": "its value: n^3, pixels^2, or a count",
    "n": OPERATORS["n"],
    "pixels": "rows, and columns, of each detector",
    "views": OPERATORS["views"],
    "batch": "volumes on the same rays",
    "channels": "of each volume",
    "threads": OPERATORS["threads"],
    **{
        name: OPERATORS[name]
        for name in ("status", "note", "forward_ms", "adjoint_ms", "calls", "load")
    },
}

SMALL_KEYS = ("part", "options", "device", "dtype", "threads", "n", "pixels", "views")

#: `bench=small`.
SMALL = {
    **{
        name: SCALING[name]
        for name in ("part", "method", "options", "backend", "device", "dtype", "threads")
    },
    **{name: SCALING[name] for name in ("n", "pixels", "views", "status")},
    "iteration_ms": "SIRT, its weights included, in ms / iterations: median of at least `repeats`",
    "forward_ms": "y = A x alone, in ms, likewise",
    "adjoint_ms": "A^T y alone, in ms, likewise",
    "arithmetic_ms": "time of the rays of both in ms: views x the time of one more view",
    "over_arithmetic": "iteration_ms / arithmetic_ms: 1 if a call has no overhead",
    "calls": "number of runs of SIRT for the median",
    "load": OPERATORS["load"],
}

METHODS_KEYS = (
    *("part", "options", "scene", "camera", "n", "slices", "ratio", "views", "device", "threads"),
)

#: `bench=methods`.
METHODS = {
    "part": "method, by its name in the registry",
    "options": OPERATORS["options"],
    **{name: OPERATORS[name] for name in ("scene", "camera", "n")},
    "slices": "voxels along z; 0: n",
    **{name: OPERATORS[name] for name in ("ratio", "views", "device", "dtype", "threads")},
    "status": OPERATORS["status"],
    "error": "|x - t| / |t| over the voxels of the object, t the mean of the phantom in each voxel",
    "ms": "one reconstruction in ms, weights and filters included: median of at least `repeats` "
    "timed alternately with the other parts of the case",
    "iterations_timed": "blank: the whole run; else ms is scaled from so many iterations, of a run "
    "that would take longer than `limit_s`, and there is no error",
    "peak_mb": "peak memory of a call in 2^20 bytes, with its result, above that in use before",
    "peer": "the part for `over_peer`",
    "over_peer": "ms / that of the peer",
    "calls": "number of calls for the median",
    "load": OPERATORS["load"],
}

SKIP_KEYS = ("scene", "rig", "method", "task", "mode", "n", "device", "threads")

#: `bench=skip`.
SKIP = {
    "scene": "the object, by its name in the configuration",
    "source": "of its volume: a phantom, a case of a file, or a substitute",
    "rig": "the cameras, by their name in the configuration",
    "method": "of the projector",
    "task": "forward: A x of a new volume at every call; forward_static: A x, the support given "
    "once; "
    "adjoint: A^T y inside the support, given once, y white noise; sirt20: 20 iterations of SIRT "
    "inside the hull of "
    "the views; cross_view: the model end to end",
    "mode": "off: nothing is skipped; cropped: nothing, on the volume cropped to the box of its "
    "non-zero voxels; others: "
    "`skip` of the projector, of the model its `support`",
    "n": "voxels along each edge; none for a checkpoint's own grid",
    "device": OPERATORS["device"],
    "threads": OPERATORS["threads"],
    "grid": "voxels along z, y, x of the whole volume",
    "views": "cameras x rows x columns",
    "status": OPERATORS["status"],
    "chosen": "what the last call skipped, as the operator reports (of the model: its support)",
    "why": "reason for that choice",
    "occupancy": "share of non-zero voxels",
    "box": "share of the volume in the box around them",
    "support": "share of the voxels in the hull of the views, of sirt20 and the model",
    "ms": "one call in ms: median of at least `repeats`, timed alternately with the other modes; "
    "includes building the mask, except for forward_static, adjoint, off and cropped",
    "over_full": "speed relative to off: its ms / ms",
    "over_crop": "speed relative to cropped: its ms / ms",
    "build_ms": "building the mask, in ms; blank if every call builds its own",
    "error": "greatest absolute difference from off; of the adjoint inside the support",
    "differing": "number of values that are not bitwise equal to those of off",
    "psnr": "against the truth in dB, mean over `cases`; blank for an untrained model",
    "psnr_loss": "psnr of off minus that of the mode, in dB",
    "peak_mb": "peak memory of a call in 2^20 bytes, with its result, above that in use before",
    "calls": "number of calls for the median",
    "load": OPERATORS["load"],
}

PRECISION_KEYS = ("task", "precision", "n", "device", "threads")

#: `bench=precision`.
PRECISION = {
    "task": "the computation",
    "precision": "storage of volumes, views and weights; autocast: arithmetic of the networks",
    "n": "voxels along each edge; of a checkpoint, its own",
    "device": OPERATORS["device"],
    "threads": OPERATORS["threads"],
    "status": OPERATORS["status"],
    "error": "|y - t| / |t|, t in float64 from unrounded operands",
    "worst": "greatest absolute error / greatest absolute value of t",
    "not_finite": "values that are NaN or infinite",
    "ms": "one call in ms: median of at least `repeats`, timed alternately with the others",
    "ratio": "ms / that of float32",
    "peak_mb": "peak memory of a call in 2^20 bytes, with its result, above that in use before",
    "psnr": "against the truth in dB; blank for an untrained model",
    "calls": "number of calls for the median",
    "load": OPERATORS["load"],
}

EMISSION_KEYS = ("model", "method", "n", "pixels")

#: `bench=emission`.
EMISSION = {
    "model": "of the projector spect: plain, attenuated, blur, or both",
    "method": "of the projector",
    "n": "voxels along each edge",
    "pixels": "along each edge of 80 detectors",
    "status": OPERATORS["status"],
    "cpu_s": "processor seconds of an iteration of MLEM, A x and A^T y, with one thread: median of "
    "`repeats` timed alternately with the other models",
    "over_plain": "cpu_s / that of plain footprints",
    "load": OPERATORS["load"],
}
