"""Random rigs: guaranteed properties."""

import pytest
import torch

from mvrecon.data.digests import of_rig
from mvrecon.geometry.cameras.random_rigs import PATHS, random_rig
from tests.geometry.cameras.rigs import OPTIONS

DRAWS = OPTIONS["random"]


@pytest.mark.parametrize("path", PATHS)
def test_every_camera_looks_at_the_origin_and_covers_the_field_there(path):
    for seed in range(8):
        rig = random_rig(**DRAWS, paths=[path], seed=seed)
        rows, columns = rig.shape
        assert 4 <= len(rig) <= 6 and 5 <= rows <= 9 and 5 <= columns <= 9
        u, v, _ = rig.project(torch.zeros(1, 3, dtype=torch.float64)).unbind(-1)
        middle = torch.tensor([(columns - 1) / 2, (rows - 1) / 2], dtype=torch.float64)
        assert torch.allclose(torch.cat([u, v], -1), middle.expand(len(rig), 2), atol=1e-6)
        sid = rig.source.norm(dim=-1)
        low, high = (0.8, 1.2) if path == "scattered" else (1.0, 1.0)
        assert (sid >= 300 * low - 1e-9).all() and (sid <= 500 * high + 1e-9).all()
        magnification = rig.distance / sid
        assert (magnification > 1.3 - 1e-9).all() and (magnification < 2 + 1e-9).all()
        field = torch.stack([rig.v.norm(dim=-1) * rows, rig.u.norm(dim=-1) * columns], dim=-1)
        expected = torch.tensor([60.0, 90.0], dtype=torch.float64)
        assert torch.allclose(field / magnification[:, None], expected.expand(len(rig), 2))


def test_a_seed_determines_the_rig():
    digests = [of_rig(random_rig(**DRAWS, seed=seed)) for seed in [*range(20), 0]]
    assert len(set(digests)) == 20 and digests[0] == digests[-1]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"n_views": (6, 4)}, "n_views as a pair"),
        ({"sid": (0.0, 4.0)}, "sid as a pair"),
        ({"magnification": (0.9, 2.0)}, "magnification above 1"),
        ({"paths": ["square"]}, "paths of circle, arc"),
    ],
)
def test_invalid_random_rigs_are_refused(option, message):
    with pytest.raises(ValueError, match=message):
        random_rig(**{**DRAWS, **option})
