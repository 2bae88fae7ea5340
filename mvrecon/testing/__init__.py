"""Contract checks for all parts of a kind, and the laws that they measure, for mvrecon and for
authors of plugins.
"""

from mvrecon.testing.camera import check_camera as check_camera
from mvrecon.testing.measures import (
    adjoint_gap as adjoint_gap,
    batch_gap as batch_gap,
    bits as bits,
    derivative_gap as derivative_gap,
    gap as gap,
    gradient_gap as gradient_gap,
    homogeneity_gap as homogeneity_gap,
    inner_product_gap as inner_product_gap,
    linearity_gap as linearity_gap,
    motion_gap as motion_gap,
    skip_gap as skip_gap,
    subset_gap as subset_gap,
    support_gap as support_gap,
)
from mvrecon.testing.method import (
    check_head as check_head,
    check_method as check_method,
    check_network as check_network,
    check_weighting as check_weighting,
)
from mvrecon.testing.projector import check_projector as check_projector
from mvrecon.testing.scene import check_scene as check_scene
