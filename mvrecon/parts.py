"""mvrecon's own parts, as strings, so that listing them imports nothing."""

from mvrecon.registry import Registry

SCENES = Registry(
    "scene",
    ellipsoids="mvrecon.scenes.ellipsoids:RandomEllipsoids",
    derenzo="mvrecon.scenes.derenzo:RandomDerenzo",
    defrise="mvrecon.scenes.defrise:Defrise",
    shepp_logan="mvrecon.scenes.shepp_logan:SheppLogan",
    mixture="mvrecon.scenes.mixture:Mixture",
    hdf5="mvrecon.data.volumes:Hdf5Volumes",
    nifti="mvrecon.data.volumes:NiftiVolume",
    volumes="mvrecon.data.volume_scene:Volumes",
)
CAMERAS = Registry(
    "camera",
    circular="mvrecon.cameras.rigs:circular",
    arc="mvrecon.cameras.rigs:arc",
    dome="mvrecon.cameras.rigs:dome",
    random="mvrecon.cameras.random_rigs:random_rig",
    parallel="mvrecon.cameras.rigs:parallel",
    from_file="mvrecon.cameras.files:from_file",
    dcspect80="mvrecon.cameras.dcspect80:dcspect80",
    rtk_xml="mvrecon.cameras.formats.rtk_xml:read",
    tigre="mvrecon.cameras.formats.tigre:read",
    astra="mvrecon.cameras.formats.astra:read",
    angles="mvrecon.cameras.formats.angles:read",
    matrices="mvrecon.cameras.formats.matrices:read",
)
PROJECTORS = Registry(
    "projector",
    drr="mvrecon.projectors.drr:Drr",
    radon="mvrecon.projectors.radon:Radon",
)
HEADS = Registry(
    "head",
    softmax_depth="mvrecon.models.heads:SoftmaxDepth",
    density="mvrecon.models.heads:Density",
)
NETWORKS = Registry(
    "network",
    unet="mvrecon.models.network:UNet3d",
)
#: Methods `method(views, A) -> Reconstruction`: modules, and functions f(A, views, **options) that
#: return a volume; see `models/method.py`.
METHODS = Registry(
    "method",
    cross_view="mvrecon.models.cross_view:CrossView",
    world_unet="mvrecon.models.world_unet:WorldUNet",
    mean_fusion="mvrecon.models.mean_fusion:MeanFusion",
    geometry_free="mvrecon.models.geometry_free:GeometryFree",
    aligned="mvrecon.models.aligned:Aligned",
    uncertain="mvrecon.models.uncertain:Uncertain",
    backprojection="mvrecon.reconstructors.iterative:backprojection",
    fbp="mvrecon.reconstructors.filtered.fdk:fbp",
    fdk="mvrecon.reconstructors.filtered.fdk:fdk",
    trained="mvrecon.engine.trained_method:TrainedMethod",
    sirt="mvrecon.reconstructors.iterative:sirt",
    os_sart="mvrecon.reconstructors.os_sart:os_sart",
    cgls="mvrecon.reconstructors.cgls:cgls",
    tikhonov="mvrecon.reconstructors.tikhonov:tikhonov",
    fista_tv="mvrecon.reconstructors.fista_tv:fista_tv",
    pdhg_tv="mvrecon.reconstructors.pdhg_tv:pdhg_tv",
    mlem="mvrecon.reconstructors.mlem:mlem",
    osem="mvrecon.reconstructors.mlem:osem",
    bsrem="mvrecon.reconstructors.bsrem:bsrem",
    tv_map="mvrecon.reconstructors.tv_map:tv_map",
    finer="mvrecon.reconstructors.finer:finer",
)
#: The reconstructors that read the views block by block: f(read, cameras, grid, **options).
STREAMED = Registry(
    "streamed reconstructor",
    fdk="mvrecon.reconstructors.filtered.streaming:fdk_streamed",
)
#: Files of views that are read as one array, by their endings: f(path) -> ProjectionStack.
VIEW_FILES = Registry(
    "views",
    h5="mvrecon.data.projections.arrays:Hdf5Views",
    hdf5="mvrecon.data.projections.arrays:Hdf5Views",
    npy="mvrecon.data.projections.arrays:NpyViews",
    mha="mvrecon.data.projections.arrays:ItkViews",
    mhd="mvrecon.data.projections.arrays:ItkViews",
    nrrd="mvrecon.data.projections.arrays:ItkViews",
)
#: What corrects views before they are reconstructed: f(A, views, **options) -> CorrectedViews.
CORRECTIONS = Registry(
    "correct",
    align="mvrecon.calibration.self_alignment:self_aligned",
)
#: What a training takes by name besides its parts; of callbacks and loggers mvrecon's own and
#: Lightning's are named by `_target_`.
OPTIMIZERS = Registry(
    "optimizer", adamw="torch.optim:AdamW", adam="torch.optim:Adam", sgd="torch.optim:SGD"
)
CALLBACKS = Registry("callback")
LOGGERS = Registry("logger")
#: Terms of the loss: f(out, batch, data_range) -> a scalar, by the name of their weight.
LOSSES = Registry("loss")
#: Figures of merit: f(volume, truth, inside, data_range) -> a number, of all that are there.
METRICS = Registry("metric")

REGISTRIES = {
    r.kind: r
    for r in (
        SCENES,
        CAMERAS,
        PROJECTORS,
        HEADS,
        NETWORKS,
        METHODS,
        CORRECTIONS,
    )
}
#: All that `mvrecon-list` shows: besides the parts that a configuration names by `name`, what a
#: training takes by name, and readers of views.
LISTED = REGISTRIES | {
    r.kind: r for r in (OPTIMIZERS, CALLBACKS, LOGGERS, LOSSES, METRICS, STREAMED, VIEW_FILES)
}
