"""Columns of `results.csv`: meaning and unit of each."""

KEYS = ("part", "options", "device", "dtype", "threads", "scene", "camera", "n", "ratio", "views")

#: `bench=operators`.
OPERATORS = {
    "part": "projector, by its name in the registry",
    "method": "its option of that name, where it has one",
    "options": "all its options, as JSON",
    "backend": "what computed, as far as the part tells: cpu, cuda, reference, or own of another "
    "library",
    "device": "where volume and views are",
    "dtype": "in which volume and views are kept; float16 and bfloat16 are storage, the "
    "arithmetic is the part's",
    "threads": "threads of torch",
    "scene": "the object, whose integrals are known in closed form",
    "camera": "the rig",
    "n": "voxels along each edge of the volume",
    "ratio": "pixel / voxel, both at the isocentre",
    "views": "number of cameras",
    "pixels": "rows x columns of each detector",
    "rays": "views x pixels",
    "status": "ok, or skipped: and the reason",
    "note": "calls that gave no figure, or that were too slow to repeat",
    "error_thin": "|A x - t| / |t| over all pixels, t the exact integrals along the pixels' "
    "central rays",
    "error_pixel": "the same, t the mean of exact integrals along rays x rays lines to a pixel",
    "floor_thin": "error_thin of the exact integrals of the same voxels (Siddon in float64)",
    "floor_pixel": "error_pixel of the same integrals; an interpolating method may err less",
    "forward_ms": "y = A x, in ms: median of at least `repeats` calls, launch included, the first "
    "call not",
    "adjoint_ms": "A^T y, in ms, likewise",
    "volume_grad_ms": "forward and backward to the volume, in ms, likewise",
    "pose_grad_ms": "forward and backward to the cameras, in ms, likewise",
    "first_ms": "the first forward call in ms: compiling, where this process had not done it "
    "before, and loading",
    "calls": "the least number of calls of which one of the four times is the median",
    "forward_ratio": "forward_ms / that of the first part of the list, timed in turns with it",
    "adjoint_ratio": "adjoint_ms / that of the first part, likewise",
    "volume_grad_ratio": "volume_grad_ms / that of the first part, likewise",
    "pose_grad_ratio": "pose_grad_ms / that of the first part, likewise",
    "peak_mb": "most memory in 2^20 bytes of a forward call beyond what was in use before it, its "
    "output included",
    "adjoint_peak_mb": "the same of an adjoint call",
    "ray_slabs_per_s": "rays x n / forward time: nominal, whatever is skipped",
    "adjointness": "|<A x, y> - <x, A^T y>| / (|A x| |y|) for random x and y",
    "repeatable": "whether forward and adjoint give the same bits twice",
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
    "axis": "what is varied: voxels, rays (of each view), views, batch, channels or threads",
    "size": "how much of it: n^3, pixels^2, or the count",
    "n": OPERATORS["n"],
    "pixels": "rows, and columns, of each detector",
    "views": OPERATORS["views"],
    "batch": "volumes, each with channels of its own, on the same rays",
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
    "arithmetic_ms": "what the rays of forward and adjoint take in ms: views x the time that one "
    "view more adds to both",
    "over_arithmetic": "iteration_ms / arithmetic_ms: 1 where a call costs nothing but its rays",
    "calls": "how many calls of SIRT iteration_ms is the median of",
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
    "taken in turns with the other parts of the case",
    "iterations_timed": "blank: the whole run; else ms is scaled from so many iterations, of a run "
    "that would take longer than `limit_s`, and there is no error",
    "peak_mb": "most memory in 2^20 bytes of a call beyond what was in use before it, its result "
    "included",
    "peer": "the part that the time is divided by",
    "over_peer": "ms / that of the peer",
    "calls": "how many calls ms is the median of",
    "load": OPERATORS["load"],
}

SKIP_KEYS = ("scene", "rig", "method", "task", "mode", "n", "device", "threads")

#: `bench=skip`.
SKIP = {
    "scene": "what is looked at, by its name in the configuration",
    "source": "where its volume is from: a phantom, a file's case, or what stands in for it",
    "rig": "the cameras, by their name in the configuration",
    "method": "of the projector",
    "task": "forward: A x of a volume that is another at every call; forward_static: A x, the "
    "support given once; "
    "adjoint: A^T y inside the support, given once, y white noise; sirt20: 20 iterations of SIRT "
    "inside the hull of "
    "the views; cross_view: the model end to end",
    "mode": "off: nothing is skipped; cropped: nothing, on the volume cropped to the box around "
    "what is there; others: "
    "`skip` of the projector, of the model its `support`",
    "n": "voxels along each edge; none where a checkpoint brings its own grid",
    "device": OPERATORS["device"],
    "threads": OPERATORS["threads"],
    "grid": "voxels along z, y, x of the whole volume",
    "views": "cameras x rows x columns",
    "status": OPERATORS["status"],
    "chosen": "what the last call did, as the operator (of the model: the support) tells",
    "why": "and why",
    "occupancy": "part of the voxels that are not zero",
    "box": "part of the volume that the box around them takes",
    "support": "part of the voxels in the hull of the views, of sirt20 and the model",
    "ms": "one call in ms: median of at least `repeats` taken in turns with the other modes; "
    "building the mask is part "
    "of it but for forward_static and adjoint, and nothing is charged to off and cropped for "
    "theirs",
    "over_full": "how many times as fast as off: its ms / ms",
    "over_crop": "how many times as fast as cropped: its ms / ms",
    "build_ms": "building the mask, in ms; blank where every call does so by itself",
    "error": "greatest absolute difference of a value from that of off; of the adjoint inside the "
    "support",
    "differing": "how many values differ from those of off in any bit",
    "psnr": "against the truth in dB, mean over `cases`; blank for a model that is not trained",
    "psnr_loss": "that of off less that of the mode, in dB",
    "peak_mb": "most memory in 2^20 bytes of a call beyond what was in use before it, its result "
    "included",
    "calls": "how many calls ms is the median of",
    "load": OPERATORS["load"],
}

PRECISION_KEYS = ("task", "precision", "n", "device", "threads")

#: `bench=precision`.
PRECISION = {
    "task": "what is computed",
    "precision": "in which volumes, views and weights are stored; autocast: in which networks "
    "compute",
    "n": "voxels along each edge; of a checkpoint its own",
    "device": OPERATORS["device"],
    "threads": OPERATORS["threads"],
    "status": OPERATORS["status"],
    "error": "|y - t| / |t|, t the same in float64 from operands that were never rounded",
    "worst": "greatest absolute error / greatest absolute value of t",
    "not_finite": "values that are NaN or infinite",
    "ms": "one call in ms: median of at least `repeats` taken in turns with the other precisions",
    "ratio": "ms / that of float32",
    "peak_mb": "most memory in 2^20 bytes of a call beyond what was in use before it, its result "
    "included",
    "psnr": "against the truth in dB; blank for a model that is not trained",
    "calls": "how many calls ms is the median of",
    "load": OPERATORS["load"],
}

EMISSION_KEYS = ("model", "rays_per_pixel", "n", "pixels")

#: `bench=emission`.
EMISSION = {
    "model": "of the projector spect: plain, attenuated, blur, or both",
    "rays_per_pixel": "rays each way in a pixel",
    "n": "voxels along each edge",
    "pixels": "along each edge of 80 detectors",
    "status": OPERATORS["status"],
    "cpu_s": "processor seconds of an iteration of MLEM, A x and A^T y, with one thread: median of "
    "`repeats` taken in turns with the other models",
    "over_plain": "cpu_s / that of plain with one ray",
    "over_one_ray": "cpu_s / that of the same model with one ray",
    "load": OPERATORS["load"],
}
