"""An F, unlike its mirror images, lands where a viewer would see it: upright before a virtual or
X-ray detector, turned by 180 degrees on a detector behind a pinhole. Depth, too, has its sign."""

import pytest
import torch

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.files import save
from mvrecon.geometry.cameras.rigs import circular
from tests.geometry.cameras.rigs import DETECTOR, OPTIONS

# Key points (right, up) in mm as a viewer reads the letter: foot, head, ends of the long upper and
# short lower bar.
F = {"foot": (-4.0, -8.0), "head": (-4.0, 8.0), "upper": (6.0, 8.0), "lower": (3.0, 1.0)}


def written_for(camera):
    """The F in the world, facing one camera, upright along its own image's upwards; its key points
    in order.
    """
    right, down = (torch.nn.functional.normalize(x[0], dim=0) for x in (camera.u, camera.v))
    return torch.stack([a * right - b * down for a, b in F.values()])


def pitch(camera):
    return torch.stack([camera.u[0].norm(), camera.v[0].norm()])


@pytest.mark.parametrize(
    ("name", "magnification", "turned"),
    [
        ("circular", 2.0, 1),
        ("arc", 700 / 400, 1),
        ("parallel", 1.0, 1),
        ("dome", 70 / 200, -1),
        ("dcspect80", None, -1),
        ("from_file", 2.0, 1),
    ],
)
def test_the_letter_is_projected_where_a_viewer_sees_it(name, magnification, turned, tmp_path):
    if name == "from_file":
        save(circular(**(OPTIONS["circular"] | {"detector": DETECTOR})), tmp_path / "rig.json")
        options = {"path": tmp_path / "rig.json"}
    else:
        options = OPTIONS[name] | ({} if name == "dcspect80" else {"detector": DETECTOR})
    for camera in CAMERAS.build(name, **options):
        scale = magnification or (camera.distance / camera.source.norm()).item()
        images = camera.project(written_for(camera))[0]
        image = (
            torch.tensor([(a, -b) for a, b in F.values()], dtype=torch.float64)
            * scale
            * turned
            / pitch(camera)
        )
        middle = torch.tensor([4.0, 2.5], dtype=torch.float64)
        torch.testing.assert_close(images[:, :2], middle + image, rtol=0, atol=1e-9)
        assert (images[:, 2] * turned > 0).all()


@pytest.mark.parametrize(
    ("name", "up"), [("circular", -1), ("arc", -1), ("parallel", -1), ("dome", 1), ("dcspect80", 1)]
)
def test_up_in_the_world_is_up_in_the_image_unless_a_pinhole_turns_it(name, up):
    """The letter F is upright along +z; its top is above its base in all but pinhole images."""
    foot, head = torch.tensor([[0.0, 0, -4], [0, 0, 4]], dtype=torch.float64)
    cameras = CAMERAS.build(name, **OPTIONS[name])
    rise = cameras.project(head)[:, 1] - cameras.project(foot)[:, 1]
    assert (rise * up > 0).all()


def test_the_letter_on_the_wall_x_is_zero_read_from_plus_x_and_mirrored_from_minus_x():
    """From +x a viewer with z up has +y to the right, so the F's bars point to larger u; from -x to
    smaller u.
    """
    stem, bar = torch.tensor([[0.0, -4, 8], [0, 6, 8]], dtype=torch.float64)
    for name in ("circular", "parallel"):
        options = OPTIONS[name] | {"n_views": 2, "arc_degrees": 360.0}
        cameras = CAMERAS.build(name, **options)
        across = cameras.project(bar)[:, 0] - cameras.project(stem)[:, 0]
        assert across[0] > 0 > across[1]


def test_the_nearer_point_has_the_smaller_depth_or_the_larger_behind_a_pinhole():
    near, far = torch.tensor([[50.0, 0, 0], [-50, 0, 0]], dtype=torch.float64)
    front = CAMERAS.build("circular", **OPTIONS["circular"])[0]
    assert front.project(near)[0, 2] == pytest.approx(350) and front.project(far)[
        0, 2
    ] == pytest.approx(450)
    top = CAMERAS.build("dome", **(OPTIONS["dome"] | {"n_views": 1, "aperture_degrees": 1e-3}))
    above, below = torch.tensor([[0.0, 0, 50], [0, 0, -50]], dtype=torch.float64)
    assert top.project(above)[0, 2] == pytest.approx(-150) and top.project(below)[
        0, 2
    ] == pytest.approx(-250)
