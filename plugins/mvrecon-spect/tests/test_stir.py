"""Pinhole systems of STIR: places by independent arithmetic, round trips, and bad files."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.apps.config import absolute_paths, compose
from mvrecon.apps.progress import Bar
from mvrecon.apps.reconstruct import read_scan, run_reconstruction
from mvrecon.apps.run_method import Method, run_method
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_spect.files.interfile_volume import (
    read_interfile,
    read_mu,
    write_interfile_volume as write_volume,
    write_mu,
)
from mvrecon_spect.files.stir import StirScan, read_stir, write_stir
from mvrecon_spect.files.stir_operator import operator_of, stir_projector
from mvrecon_spect.files.stir_system import StirSystem, accepted, cameras_of, system_of
from mvrecon_spect.files.stir_text import CollimatorText, DetectorText, Opening, Ring
from mvrecon_spect.operators.matter import attenuation_on
from mvrecon_spect.operators.projector import Spect

POINT = torch.tensor([4.0, -3.0, 2.5], dtype=torch.float64)
PLACE = (1.2, -0.4, 0.7)  # of the holes, in mm


def scanner(model: str = "pol", step: float = 80.0, holes: int = 1) -> StirSystem:
    """Four detectors of 8 x 10 pixels, from 35 degrees on, 47.5 + 3 / 2 mm from the axis."""
    openings = tuple(
        Opening(
            detector,
            ((35.0 + detector * step) if model == "cyl" else PLACE[0] - 2 * k, *PLACE[1:]),
            "round",
            (1.0, 1.0),
        )
        for detector in range(4)
        for k in range(holes)
    )
    return StirSystem(
        shape=(8, 10),
        pixel_mm=(2.0, 1.5),
        radius_mm=47.5,
        detector=DetectorText(0.4, 3.0, 0.4407, (Ring(4, 35.0, step),)),
        collimator=CollimatorText(model, 28.0, 10.0, openings),  # type: ignore[arg-type]
    )


def scan(step: float = 80.0) -> StirScan:
    counts = torch.poisson(
        torch.full((1, 1, 4, 8, 10), 7.0), generator=torch.Generator().manual_seed(0)
    )
    return StirScan(scanner(step=step), counts)


@pytest.mark.parametrize("step", [80.0, -80.0])
def test_a_point_is_projected_by_similar_triangles(step: float):
    uvz = cameras_of(scanner(step=step)).project(POINT)
    for j in range(4):
        t = math.radians(35.0 + j * step)
        x = POINT[0] * math.cos(t) + POINT[1] * math.sin(t)
        y = POINT[1] * math.cos(t) - POINT[0] * math.sin(t)
        hole, plane = 28.0 + PLACE[1], 47.5 + 1.5
        longer = (plane - y) / (
            hole - y
        )  # the way from the point to the plane over that to the hole
        column = (x + (PLACE[0] - x) * longer) / 1.5 + 4.5
        row = (POINT[2] + (PLACE[2] - POINT[2]) * longer) / 2.0 + 3.5
        assert uvz[j, :2].tolist() == pytest.approx([column.item(), row.item()], abs=1e-9)
        assert -uvz[j, 2].item() == pytest.approx((hole - y).item(), abs=1e-9)


def test_a_hole_of_a_cylinder_at_the_detector_s_angle_is_centred():
    flat, curved = cameras_of(scanner()), cameras_of(scanner("cyl"))
    along = flat.u / flat.u.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(curved.source, flat.source - PLACE[0] * along)


@pytest.mark.parametrize("step", [80.0, -80.0])
def test_files_round_trip(tmp_path: Path, step: float):
    first = scan(step)
    write_stir(tmp_path, first)
    again = read_stir(*files(tmp_path))
    assert torch.equal(again.counts, first.counts)
    for key in ("source", "origin", "u", "v"):
        torch.testing.assert_close(
            getattr(cameras_of(again.system), key), getattr(cameras_of(first.system), key)
        )
    assert again.system.detector.sigma_mm == pytest.approx(0.4)
    assert again.system.collimator.openings[2].acceptance_degrees == (45.0, 45.0)


def test_a_rig_that_rotates_about_z_is_a_stir_system():
    rig = cameras_of(scanner(), world="LPS")
    again = system_of(rig, diameter_mm=1.0, crystal_mm=3.0, world="LPS")
    torch.testing.assert_close(cameras_of(again, world="LPS").source, rig.source)
    torch.testing.assert_close(cameras_of(again, world="LPS").origin, rig.origin)
    assert again.radius_mm == pytest.approx(47.5)
    with pytest.raises(ValueError, match="STIR has no other"):
        system_of(dcspect80(pixels=8), diameter_mm=2.3)


def test_holes_of_one_detector_add_up_within_their_acceptance_angles():
    grid = Grid.centred(8, spacing=4.0)
    x = torch.rand(1, 1, 8, 8, 8, generator=torch.Generator().manual_seed(1))
    both = scanner(holes=2)
    openings = both.collimator.openings
    single = [
        replace(both, collimator=both.collimator._replace(openings=openings[k::2])) for k in (0, 1)
    ]
    parts = [Spect(grid, cameras_of(one), 1.0)(x) for one in single]
    torch.testing.assert_close(operator_of(both, grid)(x), parts[0] + parts[1])
    # half of 12 degrees: 21.4 mm to the plane, 4.55 mm each way, from the hole at 1.2, 0.7
    narrow = tuple(replace(hole, acceptance_degrees=(12.0, 12.0)) for hole in openings[::2])
    one = replace(both, collimator=both.collimator._replace(openings=narrow))
    columns = [abs((k - 4.5) * 1.5 - 1.2) < 4.55 for k in range(10)]
    rows = [abs((k - 3.5) * 2.0 - 0.7) < 4.55 for k in range(8)]
    mask = torch.tensor(rows)[:, None] & torch.tensor(columns)
    assert torch.equal(accepted(cameras_of(one), one.openings, one.pixel_mm), mask.expand(4, 8, 10))
    torch.testing.assert_close(operator_of(one, grid)(x), parts[0] * mask)


@pytest.mark.parametrize("options", [{"mu": 0.02}, {"acceptance_degrees": 8.0}], ids=str)
def test_the_options_of_a_pinhole_are_those_of_the_operator(options: dict):
    """Attenuation, the edge, and any other option of `Spect`, with one hole and with several; they
    change the views.
    """
    grid = Grid.centred(8, spacing=4.0)
    x = torch.rand(1, 1, 8, 8, 8, generator=torch.Generator().manual_seed(1))
    both, one = scanner(holes=2), scanner()
    holes = both.collimator.openings
    parts = [
        replace(both, collimator=both.collimator._replace(openings=holes[k::2])) for k in (0, 1)
    ]
    each = [Spect(grid, cameras_of(part), 1.0, **options)(x) for part in (one, *parts)]
    torch.testing.assert_close(operator_of(one, grid, **options)(x), each[0])
    torch.testing.assert_close(operator_of(both, grid, **options)(x), each[1] + each[2])
    assert not torch.allclose(operator_of(one, grid)(x), each[0], rtol=1e-3)


def test_volumes_keep_their_values_and_position(tmp_path: Path):
    grid = Grid.centred(size=(4, 5, 6), spacing=(1.0, 2.0, 3.0), centre=(0.5, 1.0, 9.0))
    values = torch.rand(grid.shape, generator=torch.Generator().manual_seed(2)) / 20
    write_volume(tmp_path / "a.hv", values, grid)
    again, there = read_interfile(tmp_path / "a.hv")
    assert torch.equal(again, values) and torch.equal(there.affine, grid.affine)
    middle = read_interfile(tmp_path / "a.hv", place="centred")[1].centre
    assert middle.tolist() == [0.0, 0.0, 0.0]
    write_mu(tmp_path / "mu.hv", values, grid)
    assert np.fromfile(tmp_path / "mu.v", "<f4").max() == pytest.approx(10 * values.max().item())
    torch.testing.assert_close(attenuation_on(grid, tmp_path / "mu.hv").mu, values)
    with pytest.warns(UserWarning, match="is the file in 1/mm"):
        write_volume(tmp_path / "a.hv", values / 10, grid)
        read_mu(tmp_path / "a.hv")


def stir_origin(path: Path) -> list[float]:
    """The origin (x, y, z) that STIR gives a volume, as its `read_interfile_image` does: the first
    pixel offset less the least index times the voxel size, where indices count from -(N // 2) along
    x and y and from 0 along z; 0 without offsets.
    """
    pairs = [line.split(":=") for line in path.read_text().splitlines()]
    known = {key.strip().lstrip("!").replace(" [", "["): value.strip() for key, value in pairs}
    if "first pixel offset (mm)[3]" not in known:
        return [0.0, 0.0, 0.0]
    size = [int(known[f"matrix size[{axis}]"]) for axis in (1, 2, 3)]
    least = [-(size[0] // 2), -(size[1] // 2), 0]
    return [
        float(known[f"first pixel offset (mm)[{axis}]"])
        - index * float(known[f"scaling factor (mm/pixel)[{axis}]"])
        for axis, index in zip((1, 2, 3), least, strict=True)
    ]


def test_stir_finds_the_first_voxel_where_it_is(tmp_path: Path):
    """By STIR's own arithmetic; a centred volume has the origin 0, as an image without offsets, and
    so does an odd one that begins at z = 0, which is read back where it was all the same.
    """
    for size, first in (
        ((4, 5, 6), (40.0, -40.0, 7.5)),
        ((3, 3, 8), (-1.0, -2.0, 0.0)),
        ((4, 4, 4), (0.0, 0.0, 0.0)),
    ):
        centre = [f + s * (n - 1) / 2 for f, s, n in zip(first, (1.0, 2.0, 3.0), size, strict=True)]
        grid = Grid.centred(size=size, spacing=(1.0, 2.0, 3.0), centre=centre)
        write_volume(tmp_path / "a.hv", torch.ones(grid.shape), grid)
        least = [-(size[0] // 2), -(size[1] // 2), 0]
        found = [
            o + i * s
            for o, i, s in zip(stir_origin(tmp_path / "a.hv"), least, (1.0, 2.0, 3.0), strict=True)
        ]
        assert found == pytest.approx(list(first))
        assert torch.equal(read_interfile(tmp_path / "a.hv")[1].affine, grid.affine)
    centred = Grid.centred(size=(4, 5, 6), spacing=(1.0, 2.0, 3.0))
    write_volume(tmp_path / "a.hv", torch.ones(centred.shape), centred)
    assert stir_origin(tmp_path / "a.hv") == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("offsets", "centre"),
    [
        (None, [0.0, 0.0, 0.0]),  # STIR's attenuation map of its pinhole pack
        ([-4, -6, 0], [0.0, 0.0, 0.0]),  # a volume that STIR writes: origin 0
        ([-4.000002, -5.999998, 0], [0.0, 0.0, 0.0]),
        ([36, -46, 0], [39.0, -40.0, 0.0]),  # moved along x and y alone
        ([-4, -6, 12], [0.0, 0.0, 19.5]),
    ],
)
def test_offsets_of_stir_place_a_volume(tmp_path: Path, offsets, centre):
    """Sizes 4, 5, 6 and voxels of 2, 3, 3 mm; STIR's pinhole projector centres what has the
    origin 0.
    """
    write_volume(
        tmp_path / "a.hv", torch.ones(6, 5, 4), Grid.centred(size=(4, 5, 6), spacing=(2, 3, 3))
    )
    lines = [] if offsets is None else offsets
    text = (tmp_path / "a.hv").read_text().replace("originating system := mvrecon\n", "")
    more = [f"first pixel offset (mm) [{k}] := {mm}\n" for k, mm in enumerate(lines, 1)]
    (tmp_path / "a.hv").write_text(text.replace("!END OF", "".join(more) + "!END OF"))
    assert read_interfile(tmp_path / "a.hv")[1].centre.tolist() == pytest.approx(centre, abs=1e-5)


def test_offsets_that_may_be_unknown_are_refused(tmp_path: Path):
    """All 0 in a file of another program, or of two axes only."""
    write_volume(tmp_path / "a.hv", torch.ones(6, 5, 4), Grid.centred(size=(4, 5, 6), spacing=2.0))
    text = (tmp_path / "a.hv").read_text().replace("originating system := mvrecon\n", "")
    for axes, message in (((1, 2, 3), "may also mean"), ((1, 3), "of all axes or of none")):
        more = "".join(f"first pixel offset (mm) [{k}] := 0\n" for k in axes)
        (tmp_path / "a.hv").write_text(text.replace("!END OF", more + "!END OF"))
        with pytest.raises(Refused, match=message):
            read_interfile(tmp_path / "a.hv")
        assert read_interfile(tmp_path / "a.hv", place="centred")[1].centre.tolist() == [0, 0, 0]


@pytest.mark.parametrize("centre", [(40.0, -40.0, 0.0), (0.0, 0.0, 0.0), (-30.0, 25.0, 60.0)])
def test_a_map_on_an_off_centre_grid_attenuates_as_the_same_tensor(tmp_path: Path, centre):
    """Counts of each view through `projector.mu=map.hv` are those of the map in memory."""
    grid = Grid.centred(size=(12, 10, 8), spacing=(8.0, 9.0, 10.0), centre=centre)
    rig = dcspect80(pixels=8, columns=[2, 12])
    mu = torch.zeros(grid.shape)
    mu[1:-1, 2:-1, 1:-3] = 0.015
    write_mu(tmp_path / "map.hv", mu, grid)
    again, there = read_mu(tmp_path / "map.hv")
    assert torch.equal(there.affine, grid.affine)
    torch.testing.assert_close(again, mu)
    x = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(3))
    expected, counts = Spect(grid, rig, mu=mu)(x), Spect(grid, rig, mu=tmp_path / "map.hv")(x)
    torch.testing.assert_close(counts, expected)


def test_integers_of_either_byte_order_are_read_and_scaled(tmp_path: Path):
    values = np.arange(-60, 60, dtype=">i2").reshape(4, 5, 6)
    header = "\n".join(
        [
            "!INTERFILE :=",
            "name of data file := b.v",
            "data offset in bytes := 8 ; behind a label",
            "!Number Format := signed integer",
            "!number of bytes per pixel := 2",
            "image scaling factor[1] := 0.5",
            *(f"matrix size [{k}] := {n}" for k, n in ((1, 6), (2, 5), (3, 4))),
            *(f"scaling factor (mm/pixel) [{k}] := 2" for k in (1, 2, 3)),
            "!END OF INTERFILE :=",
        ]
    )
    (tmp_path / "b.hv").write_text(header)
    (tmp_path / "b.v").write_bytes(bytes(8) + values.tobytes())
    again, _ = read_interfile(tmp_path / "b.hv")
    assert np.array_equal(again.numpy(), values.astype(np.float32) / 2)


def test_the_files_can_be_loaded_by_name(tmp_path: Path, parts: None):
    write_stir(tmp_path, scan())
    views = MeasuredViews(Measured(path=str(tmp_path / "counts.hs")))
    assert torch.equal(views.whole().views, scan().counts[0, 0])
    path, detector, collimator = files(tmp_path)
    rig = CAMERAS.build(
        "stir_pinhole", path=path, detector_file=detector, collimator_file=collimator
    )
    torch.testing.assert_close(views.cameras(rig).source, cameras_of(scanner()).source)


def pack(folder: Path) -> tuple[StirSystem, torch.Tensor, Grid]:
    """A small pack of STIR's: 12 detectors of 24 x 24 pixels behind holes of 1 mm that accept 35
    degrees across and 30 degrees along the axis, with a sigma of 0.9 mm; the counts of two balls in
    water, expected; the ball's activity and its grid.
    """
    ring = Ring(12, 35.0, 30.0)
    holes = tuple(
        Opening(k, (0.4, 0.0, 0.3), "round", (1.0, 1.0), (2.0, -1.0), (35.0, 30.0))
        for k in range(12)
    )
    system = StirSystem(
        shape=(24, 24),
        pixel_mm=(1.8, 1.8),
        radius_mm=54.8,
        detector=DetectorText(0.9, 3.0, 0.44, (ring,)),
        collimator=CollimatorText("pol", 28.0, 10.0, holes),
    )
    grid = Grid.centred(size=(16, 14, 12), spacing=1.5)
    points, truth = voxel_centres(grid), torch.zeros(grid.shape)
    for place, radius, activity in (((5, -3, 2), 3.2, 2e4), ((-4, 3, -3), 2.6, 1e4)):
        truth[(points - torch.tensor(place)).norm(dim=-1) < radius] = activity
    mu = torch.full(grid.shape, 0.015)
    folder.mkdir()
    write_mu(folder / "attmap.hv", mu, grid)
    views = operator_of(system, grid, mu=mu, blur=True)(truth[None, None])
    write_stir(folder, StirScan(system, views), name="input")
    return system, truth, grid


@pytest.mark.filterwarnings("ignore:The grid reaches behind")
def test_a_stir_folder_is_reconstructed_by_the_command_without_further_options(
    tmp_path: Path, parts: None, monkeypatch: pytest.MonkeyPatch
):
    """As `docs/spect_files.md` prints it, with a path relative to the folder, on the grid that the
    app chooses; activity in counts / mm^3 keeps its sum and its place, and has no Hounsfield units.
    """
    system, truth, grid = pack(tmp_path / "scan")
    monkeypatch.chdir(tmp_path)
    options = ("views.path=scan/input.hs", "camera=stir_pinhole", "projector=stir_pinhole")
    options += ("projector.mu=scan/attmap.hv", "method=osem")
    settings = absolute_paths(compose(*options, config_name="reconstruct"), ReconstructSettings)
    table = run_reconstruction(ReconstructSettings(**settings), tmp_path / "run")
    volume, placed = read_volume(tmp_path / "run" / "volume.nii.gz")
    assert table["unit"] == "activity" and table["view_nrmse"] < 0.1
    total = volume.sum().item() * math.prod(placed.spacing)
    assert total == pytest.approx(truth.sum().item() * math.prod(grid.spacing), rel=0.05)
    middles = [
        (voxel_centres(g) * x[..., None]).sum((0, 1, 2)) / x.sum()
        for g, x in ((grid, truth), (placed, volume))
    ]
    assert (middles[0] - middles[1]).norm() < 0.5
    with pytest.raises(ValueError, match="for the unit HU, got activity"):
        run_reconstruction(ReconstructSettings(**{**settings, "unit": "HU"}), tmp_path / "in_hu")


@pytest.mark.filterwarnings("ignore:The grid reaches behind")
def test_the_operator_of_the_command_uses_sigma_and_acceptance_of_the_files(
    tmp_path: Path, parts: None
):
    """Also of every other view, binned, where it is that of those pixels."""
    system, truth, grid = pack(tmp_path / "scan")
    options = ("camera=stir_pinhole", "projector=stir_pinhole")
    options = (f"views.path={tmp_path}/scan/input.hs", *options)
    options += ("grid.size=[16,14,12]", "grid.spacing=1.5", "method=osem")
    A = read_scan(ReconstructSettings(**compose(*options, config_name="reconstruct"))).operator()
    rig = cameras_of(system)
    sharp = {"diameter_mm": 1.0}
    soft = {**sharp, "blur": True, "intrinsic_mm": 0.9 * math.sqrt(8 * math.log(2))}
    place = [(torch.arange(24).double() - 11.5) * 1.8 - at for at in (0.4, 0.3)]
    column, row = (torch.rad2deg(torch.atan(p / (54.8 + 1.5 - 28.0))) for p in place)
    mask = ((row + 1).abs() <= 30)[:, None] & ((column - 2).abs() <= 35)
    assert 200 < int(mask.sum()) < 500
    x = truth[None, None]
    torch.testing.assert_close(A(x), Spect(grid, rig, **soft)(x) * mask)
    assert (A(x) - Spect(grid, rig, **sharp)(x)).norm() > 0.1 * A(x).norm()
    some = compose(*options, "views.every=2", config_name="reconstruct")
    torch.testing.assert_close(
        read_scan(ReconstructSettings(**some)).operator()(x), A(x)[:, :, ::2]
    )
    full = torch.ones_like(x)
    for n in (2, 3, 4):  # joined pixels have all of their parts, or none
        joined = compose(*options, f"views.binning={n}", config_name="reconstruct")
        parts_of = mask.unflatten(1, (-1, n)).unflatten(0, (-1, n)).transpose(1, 2).flatten(2)
        assert not torch.equal(parts_of.any(dim=2), parts_of.all(dim=2))
        sums = A(full).unflatten(4, (-1, n)).unflatten(3, (-1, n)).sum(dim=(4, 6))
        made = read_scan(ReconstructSettings(**joined)).operator()(full)
        torch.testing.assert_close(made, sums * parts_of.all(dim=2), rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="expected the cameras of this file"):
        stir_projector(grid, dcspect80(pixels=24), tmp_path / "scan" / "input.hs")
    # a measured response, which contains the detector's, in place of sigma
    head = "depth_mm,angle_degrees,fwhm_radial_mm,fwhm_tangential_mm"
    (tmp_path / "psf.csv").write_text(f"{head}\n28,0,2.5,2.5\n")
    known = compose(*options, f"projector.response={tmp_path}/psf.csv", config_name="reconstruct")
    measured = Spect(grid, rig, 1.0, blur=True, response=tmp_path / "psf.csv")(x)
    B = read_scan(ReconstructSettings(**known)).operator()
    torch.testing.assert_close(B(x), measured * mask)


def test_the_app_reconstructs_a_stir_measurement(tmp_path: Path):
    """Attenuated counts of two balls, written in STIR's format, are reconstructed in position."""
    ring = Ring(12, 35.0, 30.0)
    holes = tuple(Opening(k, PLACE, "round", (1.0, 1.0)) for k in range(12))
    system = replace(
        scanner(),
        shape=(16, 16),
        detector=scanner().detector._replace(rings=(ring,)),
        collimator=scanner().collimator._replace(openings=holes),
    )
    grid, truth = Grid.centred(10, spacing=2.0), torch.zeros(1, 1, 10, 10, 10)
    truth[..., 3:5, 4:6, 6:8], truth[..., 6:8, 2:4, 3:5] = 2e4, 1e4
    mu = torch.full(grid.shape, 0.015)
    A = Spect(grid, cameras_of(system), 1.0, mu=mu)
    write_stir(tmp_path, StirScan(system, A(truth)))
    write_mu(tmp_path / "mu.hv", mu, grid)
    path, detector, collimator = files(tmp_path)
    options = (
        f"views.path={path}",
        "camera=stir_pinhole",
        f"camera.path={path}",
        f"camera.detector_file={detector}",
        f"camera.collimator_file={collimator}",
        "projector=spect",
        "projector.diameter_mm=1.0",
        f"projector.mu={tmp_path / 'mu.hv'}",
        "method=osem",
        "method.iterations=20",
        "grid.size=[10,10,10]",
        "grid.spacing=2.0",
    )
    settings = compose(*options, config_name="reconstruct")
    table = run_reconstruction(ReconstructSettings(**settings), tmp_path / "run")
    volume, placed = read_volume(tmp_path / "run" / "volume.nii.gz")
    torch.testing.assert_close(placed.affine, grid.affine)
    assert table["view_nrmse"] < 0.05 and table["unit"] == "activity"
    assert (volume - truth[0, 0]).norm() < 0.3 * truth.norm()
    assert volume.sum().item() == pytest.approx(truth.sum().item(), rel=0.02)
    with pytest.raises(ValueError, match="for the unit HU, got activity"):
        run_reconstruction(ReconstructSettings(**{**settings, "unit": "HU"}), tmp_path / "in_hu")


@pytest.mark.parametrize("name", ["counts.hs", "counts.npy"])
def test_counts_give_activity_without_hounsfield_units(tmp_path, name):
    settings = settings_of_counts(tmp_path, name, "projector=spect", "method=osem")
    assert read_scan(ReconstructSettings(**settings)).unit == "activity"
    with pytest.raises(ValueError, match="for the unit HU, got activity"):
        run_reconstruction(ReconstructSettings(**{**settings, "unit": "HU"}), tmp_path / "in_hu")
    assert not (tmp_path / "in_hu").exists()


@pytest.mark.filterwarnings("ignore:The grid reaches behind")
@pytest.mark.parametrize("blur", ["false", "true"])
@pytest.mark.parametrize("step", [30.0, 60.0])
def test_the_projector_supports_the_automatic_grid_of_a_scan(tmp_path, blur, step):
    ring = Ring(round(360 / step), 35.0, step)
    holes = tuple(Opening(k, (0, 0, 0), "round", (1.0, 1.0)) for k in range(ring.count))
    for pixel in (2.0, 6.0):  # of the large ones, the field ends at the pinholes' planes
        system = replace(
            scanner(),
            pixel_mm=(pixel, pixel),
            detector=scanner().detector._replace(rings=(ring,)),
            collimator=scanner().collimator._replace(openings=holes),
        )
        write_stir(tmp_path, StirScan(system, torch.ones(1, 1, ring.count, 8, 10)))
        settings = settings_of_counts(
            tmp_path,
            "counts.hs",
            "projector=spect",
            f"projector.blur={blur}",
            "grid.size=null",
            "grid.spacing=null",
            write=False,
        )
        opened = read_scan(ReconstructSettings(**settings))
        x = torch.ones(1, 1, *opened.grid.shape)
        assert opened.operator()(x).min().item() > 0


def test_interfile_counts_are_not_treated_as_line_integrals(tmp_path: Path):
    with pytest.raises(Refused, match="expected line integrals for the projector 'drr'"):
        read_scan(ReconstructSettings(**settings_of_counts(tmp_path, "counts.hs")))


@pytest.mark.parametrize("name", ["counts.hs", "counts.npy"])
def test_interfile_counts_are_a_map_of_scatter_in_counts(tmp_path: Path, name):
    """For counts in Interfile and in NumPy."""
    options = (name, "projector=spect", "method=osem")
    settings = settings_of_counts(
        tmp_path, *options, f"scatter={{name: given, path: {tmp_path}/counts.hs}}"
    )
    opened = read_scan(ReconstructSettings(**settings))
    assert torch.equal(opened.scatter, scan().counts)
    assert torch.equal(opened.measured.whole().views, scan().counts[0, 0])


def settings_of_counts(folder: Path, name: str, *options: str, write: bool = True) -> dict:
    """Of a scan of STIR's counts, in Interfile or as an array."""
    if write:
        write_stir(folder, scan())
    np.save(folder / "counts.npy", scan().counts[0, 0])
    path, detector, collimator = files(folder)
    return compose(
        f"views.path={folder / name}",
        "views.kind=integrals",
        "camera=stir_pinhole",
        f"camera.path={path}",
        f"camera.detector_file={detector}",
        f"camera.collimator_file={collimator}",
        "grid.size=[4,4,4]",
        "grid.spacing=5.0",
        *options,
        config_name="reconstruct",
    )


def files(folder: Path) -> tuple[Path, Path, Path]:
    return folder / "counts.hs", folder / "detector.txt", folder / "collimator.txt"


#: File, what is replaced by what, and what the error says.
BAD = {
    "cut short": ("counts.hs", "!END OF INTERFILE :=\n", "origin", "is it cut short"),
    "larger than the data": ("counts.hs", "[1] := 10", "[1] := 11", "expected 1408 bytes"),
    "number format": ("counts.hs", "format := float", "format := bit", "expected a number format"),
    "no key": ("counts.hs", "radius := 47.5", "", "expected the key 'radius'"),
    "no number": ("counts.hs", "radius := 47.5", "radius := far", "finite number for 'radius'"),
    "two values": ("counts.hs", "radius := 47.5", "radius := 47.5\nradius := 4", "one value of"),
    "two heads": (
        "counts.hs",
        "orbit",
        "number of detector heads := 2\nstart angle := 215\norbit",
        "'start angle', got '35.0' and '215'; .* each of 'number of detector heads' := 2: expected",
    ),
    "three windows": (
        "counts.hs",
        "orbit",
        "!number of energy windows := 3\nimage duration := 1\nimage duration := 2\norbit",
        "section for each of 'number of energy windows' := 3: expected one, write a file for each",
    ),
    "one of two values": ("counts.hs", "orbit", "radius := 4\norbit", "remove the wrong one"),
    "radius in cm": ("counts.hs", "radius := 47.5", "radius := 4.75", "text files are in cm"),
    "turns back": ("counts.hs", "CCW", "CW", "expected the detector file's angles"),
    "starts elsewhere": ("counts.hs", "start angle := 35", "start angle := 3", "a start at 3"),
    "first view elsewhere": (
        "counts.hs",
        "orbit",
        "first projection angle in data set := 3\norbit",
        "the first projection at 3",
    ),
    "other extent": ("counts.hs", "rotation := 320", "rotation := 36", "expected an extent of 320"),
    "an ellipse": ("counts.hs", "Circular", "Non-circular", "orbit circular, got"),
    "above its folder": ("counts.hs", "counts.s", "../counts.s", "in its folder or below"),
    "frames": (
        "counts.hs",
        "orbit",
        "number of time frames := 2\norbit",
        "number of time frames 1, got",
    ),
    "collimator in mm": ("collimator.txt", "radius (cm): 2.8", "radius (cm): 28.", "are in cm"),
    "says mm": ("collimator.txt", "radius (cm)", "radius (mm)", "in cm, got it in mm"),
    "says m": ("collimator.txt", "radius (cm)", "radius [m]", "in cm, got it in m"),
    "columns in mm": ("collimator.txt", "y(cm)", "y(mm)", "columns in cm and deg, got .'mm'"),
    "angles in radians": ("collimator.txt", "angx(deg)", "angx(rad)", "got .'rad'"),
    "per mm": ("detector.txt", "(cm -1)", "(1/mm)", "in cm, got it in mm"),
    "by mass": ("detector.txt", "(cm -1)", "(cm2/g)", "in cm, got it in g"),
    "mm behind a name": ("detector.txt", "Sigma (cm)", "Sigma, mm", "in cm, got it in mm"),
    "mm behind a number": ("detector.txt", "Sigma (cm): 0.04", "Sigma: 0.04 mm", "got it in mm"),
    "radians": ("detector.txt", "ang0 (deg)", "ang0 (radians)", "in deg, got it in radians"),
    "a hole less": ("collimator.txt", "holes: 4", "holes: 5", "expected 5 holes"),
    "no such hole": ("collimator.txt", "round", "star", "round or rect"),
    "no such detector": ("collimator.txt", "h4: 4", "h4: 5", "Expected holes for the detectors"),
    "a line less": ("detector.txt", "Crystal thickness (cm)", "crystal", "is a line missing"),
    "a view less": ("detector.txt", "Nangles: 4", "Nangles: 3", "as many angles as there are"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_inconsistent_stir_file_is_refused(tmp_path: Path, name: str):
    """A pinhole system of STIR whose files do not fit each other, their size or unit is refused."""
    write_stir(tmp_path, scan())
    file, before, after, message = BAD[name]
    text = (tmp_path / file).read_text()
    assert before in text
    (tmp_path / file).write_text(text.replace(before, after))
    with pytest.raises(ValueError, match=message):
        read_stir(*files(tmp_path))


def test_the_header_is_read_once(tmp_path: Path):
    """A header without its last line is warned of once."""
    write_stir(tmp_path, scan())
    header, *texts = files(tmp_path)
    header.write_text(header.read_text().replace("!END OF INTERFILE :=\n", ""))
    with pytest.warns(UserWarning, match="is it cut short") as said:
        read_stir(header, *texts)
    assert len(said) == 1


def test_interfile_data_is_a_plain_file_beside_the_header(tmp_path: Path):
    """Interfile counts are read from a plain file beside the header, and refused where negative."""
    inside, outside = tmp_path / "scan", tmp_path / "elsewhere"
    for folder in (inside, outside):
        folder.mkdir()
        write_stir(folder, scan())
    (inside / "counts.s").unlink()
    (inside / "counts.s").symlink_to(outside / "counts.s")
    with pytest.raises(ValueError, match="not through a link"):
        read_stir(*files(inside))
    (-scan().counts).numpy().astype("<f4").tofile(outside / "counts.s")
    with pytest.raises(ValueError, match="not negative"):
        read_stir(*files(outside))


@pytest.mark.filterwarnings("ignore:The grid reaches behind")
def test_counts_outside_the_acceptance_angles_are_ignored_with_a_warning(tmp_path, parts):
    """They change no voxel: the volume is that of the same views without them."""
    system, _, _ = pack(tmp_path / "scan")
    views = read_stir(tmp_path / "scan" / "input.hs").counts
    dark = ~accepted(cameras_of(system), system.openings, system.pixel_mm)
    options = ("camera=stir_pinhole", "projector=stir_pinhole", "method=osem", "grid.spacing=1.5")
    options = (f"views.path={tmp_path}/scan/input.hs", *options, "grid.size=[16,14,12]")
    settings = compose(*options, "method.iterations=2", config_name="reconstruct")
    expected = run_method(
        read_scan(ReconstructSettings(**settings)), Method.of(settings["method"]), "cpu", Bar()
    ).volume
    write_stir(tmp_path / "scan", StirScan(system, views + 3.0 * dark), name="input")
    with pytest.warns(UserWarning, match=f"Left out {3 * int(dark.sum())} of .* counts"):
        made = run_method(
            read_scan(ReconstructSettings(**settings)), Method.of(settings["method"]), "cpu", Bar()
        ).volume
    torch.testing.assert_close(made, expected)
