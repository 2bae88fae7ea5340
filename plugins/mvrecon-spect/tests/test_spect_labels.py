"""Uptake of labelled structures: where it is, how much, and what attenuates."""

import numpy as np
import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.data.hdf5 import Stored, write_volumes
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.training.evaluation import evaluate
from mvrecon.training.fit import build_data, build_module
from mvrecon.training.module import build_projector
from mvrecon.training.settings import TrainSettings
from mvrecon_spect.scenes.spect_ct import SpectCt
from mvrecon_spect.scenes.spect_labels import SpectLabels

GRID = Grid.centred(size=(14, 12, 10), spacing=8.0)
SPACING = (4.0, 4.0, 4.0)  # z, y, x
#: To the right and in front, in the middle.
GLAND, TUMOUR = torch.tensor([24.0, 12.0, 0.0]), torch.tensor([-12.0, -8.0, 4.0])
UPTAKE = {"Gland": (0.5, 1.0), "Tumour": (2.0, 3.0)}
NAMES = "1=Gland,2=Tumour,3=Cord"


def patient(name: str = "p", shift: float = 0.0) -> Stored:
    """A ball of water in air with a ball of bone, a gland and a tumour, as RAS."""
    places = voxel_centres(Grid.centred(size=(28, 24, 20), spacing=4.0), torch.float32)
    places = places - torch.tensor([shift, 0.0, 0.0])
    hu = torch.where(places.norm(dim=-1) < 40, 0, -1000)
    hu[(places - torch.tensor([0.0, 0.0, -16.0])).norm(dim=-1) < 10] = 1000
    label = torch.zeros_like(hu)
    label[(places - GLAND).norm(dim=-1) < 9] = 1
    label[(places - TUMOUR).norm(dim=-1) < 9] = 2
    return Stored(name, hu.numpy().astype("int16"), SPACING, label.numpy().astype("uint8"))


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "labelled.h5"
    write_volumes(file, [patient("p"), patient("q", 4.0)], labels=NAMES, orientation="RAS")
    return str(file)


def scene(path: str, **options) -> SpectLabels:
    return SpectLabels(**{"path": path, "uptake": UPTAKE, "fine": 2} | options)


def levels(case: SpectLabels, index: int = 0) -> dict[str, float]:
    return case.parameters(index, 0, GRID)


def test_structures_and_body_have_their_activity_and_air_has_none(path):
    case = scene(path, crop="none")
    drawn = levels(case)
    fine = case.finer(0, 0, GRID, None, 2)[0]  # the file's own voxels
    known = patient()
    label, water = torch.from_numpy(known.label).long(), torch.from_numpy(known.ct) >= 0
    table = torch.tensor([0.0, drawn["uptake_Gland"], drawn["uptake_Tumour"]])
    body = drawn["uptake_body"] * water
    assert torch.allclose(fine, torch.where(label > 0, table[label], body), atol=1e-5)
    assert 0.5 <= drawn["uptake_Gland"] <= 1 and 2 <= drawn["uptake_Tumour"] <= 3
    assert 0.05 <= drawn["uptake_body"] <= 0.15
    truth = case.pooled(0, 0, GRID, None, fine[None]).volume
    assert truth.sum().item() == pytest.approx(fine.sum().item() / 8, rel=1e-5)


def test_attenuation_is_that_of_water_and_bone_at_140_kev(path):
    mu = scene(path, crop="none").maps(0, 0, GRID, 2)["mu"][0]
    hu = torch.from_numpy(patient().ct)
    assert torch.allclose(mu[hu == 0], torch.tensor(0.01536), rtol=1e-4)
    assert torch.allclose(mu[hu == 1000], torch.tensor(0.0295), rtol=1e-4)
    assert mu[hu == -1000].abs().max() < 1e-6
    assert not scene(path, attenuates=False).maps(0, 0, GRID)["mu"].any()


def test_a_mirrored_copy_mirrors_its_structures_and_draws_new_uptakes(path):
    case = scene(path, vary="exact")
    copies = [case._placed(index, 0, GRID).mirrored for index in range(2, 18)]
    assert 0 < sum(copies) < len(copies)
    for index in (2 + copies.index(True), 2 + copies.index(False)):
        fine = case.finer(index, 0, GRID, None, 2)[0]
        mu = case.maps(index, 0, GRID, 2)["mu"][0]
        places = voxel_centres(GRID.refined(2), torch.float32)
        centre = (places * (mu > 0.004)[..., None]).sum(dim=(0, 1, 2)) / (mu > 0.004).sum()
        hot = fine > 1.5
        tumour = (places * hot[..., None]).sum(dim=(0, 1, 2)) / hot.sum() - centre
        side = torch.tensor([-1.0 if copies[index - 2] else 1.0, 1.0, 1.0])
        assert (tumour - side * TUMOUR).norm() < 4
    assert levels(case, 2) != levels(case, 4)


def test_a_case_is_a_pure_function_of_seed_and_index_whatever_came_before(path):
    first, again = scene(path, vary="exact"), scene(path, vary="exact")
    again.finer(3, 0, GRID, None, 2)
    assert torch.equal(first.finer(2, 0, GRID, None, 2), again.finer(2, 0, GRID, None, 2))


def test_an_orientation_moves_labels_with_the_values(tmp_path, path):
    known = patient()
    flips = {"ct": known.ct[::-1, ::-1, ::-1], "label": known.label[::-1, ::-1, ::-1]}
    write_volumes(
        tmp_path / "lpi.h5",
        [Stored("p", spacing=SPACING, **flips)],
        labels=NAMES,
        orientation="LPI",
    )
    values = (scene(str(file)).finer(0, 0, GRID, None, 2) for file in (tmp_path / "lpi.h5", path))
    assert torch.equal(*values)


def test_spect_ct_scans_labelled_patients(path):
    camera = {"name": "circular", "n_views": 8, "sid": 300.0, "sdd": 500.0}
    camera["detector"] = {"pixels": [24, 24], "pixel_mm": 8.0}
    scan = SpectCt({"name": "spect_labels", "path": path, "uptake": UPTAKE, "fine": 2}, camera)
    measured, mu = scan.measured(0, 0, GRID), scan.maps(0, 0, GRID)["mu"]
    assert (measured - mu).norm() < 0.4 * mu.norm()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"uptake": {"Glnd": (0.0, 1.0)}}, "structures among Gland, Tumour, Cord, got Glnd"),
        ({"uptake": {}}, "got none"),
        ({"uptake": {"Gland": (-1.0, 1.0)}}, "activity of Gland, 0 or more, got -1.0 and 1.0"),
        ({"body": (2.0, 1.0)}, "activity of body"),
        ({"uptake": {"Gland": (0.0, np.inf)}}, "activity of Gland"),
        ({"stored_unit": "activity"}, "file of HU or 1/mm"),
        ({"own_voxels": True}, "views of a finer grid"),
    ],
)
def test_invalid_uptakes_are_refused(path, options, message):
    with pytest.raises(ValueError, match=message):
        scene(path, **options)


def test_a_file_without_labels_or_names_is_refused(tmp_path):
    known = patient()
    write_volumes(tmp_path / "none.h5", [Stored("p", known.ct, SPACING)], labels=NAMES)
    write_volumes(tmp_path / "unnamed.h5", [known])
    with pytest.raises(ValueError, match="no dataset 'label'"):
        scene(str(tmp_path / "none.h5")).finer(0, 0, GRID, None, 2)
    with pytest.raises(ValueError, match="name each structure once"):
        scene(str(tmp_path / "unnamed.h5"))


@pytest.mark.filterwarnings("ignore:Rays are up to", "ignore:.*fills")
def test_the_experiment_trains_a_step_and_evaluates_every_method(tmp_path):
    names = "1=RightParotid,2=PTV70,3=LeftParotid,4=Larynx"
    files = {part: tmp_path / f"{part}.h5" for part in ("scene", "test_scene")}
    for shift, (part, file) in enumerate(files.items()):
        patients = [patient(f"{part}_{k}", 4.0 * k + shift) for k in range(3)]
        write_volumes(file, patients, labels=names)
    settings = TrainSettings(
        **compose(
            "experiment=dcspect_labels",
            *(f"{part}.path={file}" for part, file in files.items()),
            "method=cross_view_small",
            "camera.pixels=8",
            "camera.columns=[3]",
            "compare.world_unet.widths=[2]",
            "compare.bsrem.iterations=1",
            "data.sizes={train: 2, val: 1, test: 2}",
            "grid.size=[8,8,8]",
            "grid.spacing=32",
        )
    )
    data = build_data(settings)
    data.setup("fit")
    data.setup("test")
    rows = {
        label: build_module(settings, config, 1.0) for label, config in settings.methods().items()
    }
    batch = next(iter(data.train_dataloader()))
    loss = rows["cross_view"].terms(batch)["total"]
    loss.backward()
    assert loss.isfinite() and batch["mu"].max() < 0.03
    A = build_projector(settings.grid, settings.camera, settings.projector)
    judged = {label: row.method for label, row in rows.items()}
    scores = evaluate(judged, data.test_dataloader(), A, 1.0)
    assert set(scores) == {"cross_view", "world_unet", "osem", "bsrem"}
    assert all(0 < s["nrmse"] < 3 for row in scores.values() for s in row)
