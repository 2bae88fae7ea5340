"""The picture of the frames in docs/conventions.md."""

from pathlib import Path

import torch

from scripts.docs import frames


def test_a_pinhole_turns_the_letter_that_the_x_ray_camera_shows_upright(tmp_path: Path):
    """Lengths go as the distances of detector and object, 300/200 and -100/150."""
    images = [frames.image(camera)[0] for camera in frames.rigs().values()]
    xray, pinhole = ((pixels - pixels[0]) * 5.0 for pixels in images)  # mm
    upright = (frames.LETTER - frames.LETTER[0])[:, 1:] * torch.tensor([1.0, -1.0])  # v downwards
    torch.testing.assert_close(xray, 1.5 * upright)
    torch.testing.assert_close(pinhole, -upright * 100 / 150)
    frames.draw(tmp_path / "frames.png")
    assert (tmp_path / "frames.png").read_bytes().startswith(b"\x89PNG")
