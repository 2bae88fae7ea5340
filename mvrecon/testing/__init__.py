"""Contract checks for all parts of a kind, for mvrecon and for authors of plugins."""

from mvrecon.testing.method import (
    check_head as check_head,
    check_method as check_method,
    check_network as check_network,
)
from mvrecon.testing.projector import (
    check_camera as check_camera,
    check_projector as check_projector,
)
from mvrecon.testing.scene import check_scene as check_scene
