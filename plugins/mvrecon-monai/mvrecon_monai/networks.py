"""MONAI's 3-D networks (https://monai.io), built as `Network(inputs, outputs, **options)`.

`multiple` of a network states the sizes that it supports; a model pads other sizes with zeros and
crops the output. The networks use group normalisation: MONAI's default, instance normalisation,
fails if the coarsest level is a single voxel, and batches are too small for batch normalisation.
"""

from math import gcd
from typing import Any

from torch import nn

from mvrecon.operators.adapters import needs

#: Groups of channels in normalisation, MONAI's default for SegResNet; fewer if they do not divide
#: the width.
GROUPS = 8
#: Channels of nnU-Net's widest level.
WIDEST = 320


def monai_basic_unet(inputs: int, outputs: int, width: int = 32) -> nn.Module:
    """MONAI's BasicUNet: five levels with two convolutions each, from volumes to volumes.

    Source: T. Falk and others, "U-Net: deep learning for cell counting, detection, and
    morphometry", Nature Methods 2019.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        width: channels of the two finest levels; the others have 2, 4 and 8 times as many.

    Raises:
        ValueError: the width is too small.
        ImportError: MONAI is not installed.
    """
    _check(width)
    with needs("monai"):
        from monai.networks.nets.basic_unet import BasicUNet

    widths = [width * times for times in (1, 1, 2, 4, 8, 1)]
    return _sized(BasicUNet(3, inputs, outputs, widths, norm=_norm(width)), 16)


def monai_dynunet(
    inputs: int, outputs: int, width: int = 32, levels: int = 4, residual: bool = False
) -> nn.Module:
    """MONAI's DynUNet, the U-Net of nnU-Net, from volumes to volumes.

    Source: F. Isensee and others, "nnU-Net: a self-configuring method for deep learning-based
    biomedical image segmentation", Nature Methods 2021.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        width: channels of the finest level; they double with every level, up to 320 as in nnU-Net.
        levels: number of scales, including the finest; at least 3.
        residual: use residual blocks instead of pairs of convolutions.

    Raises:
        ValueError: the width or the number of levels is too small.
        ImportError: MONAI is not installed.
    """
    _check(width, levels, fewest=3)
    with needs("monai"):
        from monai.networks.nets.dynunet import DynUNet

    coarser = [2] * (levels - 1)
    widths = [width * 2**level for level in range(levels)]
    network = DynUNet(
        spatial_dims=3,
        in_channels=inputs,
        out_channels=outputs,
        kernel_size=[3] * levels,
        strides=[1, *coarser],
        upsample_kernel_size=coarser,
        filters=[min(channels, max(width, WIDEST)) for channels in widths],
        norm_name=_norm(gcd(width, WIDEST)),
        res_block=residual,
    )
    return _sized(network, 2 ** (levels - 1))


def monai_segresnet(inputs: int, outputs: int, width: int = 16) -> nn.Module:
    """MONAI's SegResNet: residual blocks on four levels, from volumes to volumes.

    Source: A. Myronenko, "3D MRI brain tumor segmentation using autoencoder regularization",
    BrainLes 2018; without the autoencoder.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        width: channels of the finest level; they double with every level.

    Raises:
        ValueError: the width is too small.
        ImportError: MONAI is not installed.
    """
    _check(width)
    with needs("monai"):
        from monai.networks.nets.segresnet import SegResNet

    return _sized(SegResNet(3, width, inputs, outputs, norm=_norm(width)), 8)


def monai_swin_unetr(inputs: int, outputs: int, width: int = 24) -> nn.Module:
    """MONAI's SwinUNETR: attention in shifted windows of 7^3 patches, from volumes to volumes.

    Source: A. Hatamizadeh and others, "Swin UNETR: Swin transformers for semantic segmentation of
    brain tumors in MRI images", BrainLes 2021.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        width: channels of the finest level, a multiple of 12; they double with every level.

    Raises:
        ValueError: the width is not a multiple of 12.
        ImportError: MONAI or einops is not installed.
    """
    _check(width)
    if width % 12:
        raise ValueError(f"width must be a multiple of 12, got {width}")
    with needs("einops"):
        import einops  # noqa: F401
    with needs("monai"):
        from monai.networks.nets.swin_unetr import SwinUNETR

    network = SwinUNETR(inputs, outputs, feature_size=width, norm_name=_norm(width))
    return _sized(network, 32)


def _check(width: int, levels: int = 1, fewest: int = 1) -> None:
    if width < 1 or levels < fewest:
        raise ValueError(
            f"Expected width of at least 1 and at least {fewest} levels, got width={width}, "
            f"levels={levels}"
        )


def _norm(width: int) -> tuple[str, dict[str, Any]]:
    """MONAI's specification of group normalisation for levels whose channels are multiples of a
    width.
    """
    return "GROUP", {"num_groups": gcd(GROUPS, width)}


def _sized(network: nn.Module, multiple: int) -> nn.Module:
    """Declare that a network supports sizes divisible by `multiple`."""
    network.multiple = multiple  # pyrefly: ignore[bad-argument-type]
    return network
