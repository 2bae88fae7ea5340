"""Pixels that measure wrongly are found, named and left out; right ones, however sharp, are not."""

import math

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image as Pillow

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.faults import wrong_in_views, zingers
from tests.data.projections.conftest import opened

VIEWS, ROWS, COLUMNS = 64, 24, 96
#: Grey values without a beam, and the beam.
DARK, BEAM = 100.0, 50_000.0
#: Cylinders along z: centre (x, y) and radius in pixels, attenuation of a pixel, half height.
BODY = [(3, -4, 35, 0.02, 9), (15, 10, 6, 0.05, 9), (-20, 5, 1, 0.3, 9), (0.3, 0, 1.5, 0.3, 7)]
METAL = [(10, 0, 5, 2, 8), (-10, 3, 5, 2, 8), (20, 20, 0.5, 8, 8)]
PLATES = [(0, 0, 35, 0.1, 0.6), (5, 0, 20, 0.05, 3.6), (5, 0, 20, -0.05, 2.6)]
PORES = [(0, 0, 38, 0.2, 9)] + [(9 * i, 9 * j, 1.2, -0.2, 9) for i in (-2, 0, 2) for j in (-1, 2)]
WIDE = [(0, 0, 150, 0.01, 30), (10, 20, 8, 0.05, 30)]


def transmissions(cylinders, rows=ROWS, views=VIEWS):
    """Parallel beams through cylinders over half a turn, in closed form [m v u]."""
    a = np.radians(np.arange(views) * 180 / views)[:, None, None]
    u = (np.arange(COLUMNS) - (COLUMNS - 1) / 2)[None, None]
    v = (np.arange(rows) - (rows - 1) / 2)[None, :, None]
    y = np.zeros((views, rows, COLUMNS))
    for x0, y0, radius, mu, half in cylinders:
        s = u - (y0 * np.cos(a) - x0 * np.sin(a))
        y += 2 * mu * np.sqrt(np.clip(radius**2 - s**2, 0, None)) * (np.abs(v) < half)
    return np.exp(-y)


def grey(light, photons=1e4, seed=0):
    """Grey values with Poisson noise and that of reading; none without photons."""
    rng = np.random.default_rng(seed)
    if photons is None:
        return np.round(DARK + BEAM * light)
    return np.round(
        DARK + BEAM * rng.poisson(light * photons) / photons + rng.normal(0, 2, light.shape)
    )


def static(*blocks):
    """Steps that a table, or a block of metal on it, makes in all views."""
    light = np.ones((ROWS, COLUMNS))
    for rows, columns, integral in blocks:
        light[slice(*rows), slice(*columns)] *= math.exp(-integral)
    return light


SCANS = {
    "object": transmissions(BODY),
    "one row": transmissions(BODY, rows=1),
    "air": transmissions([]),
    "centred": transmissions([(0, 0, 30, 0.03, 9)]),
    "table": transmissions(BODY) * static(((0, 24), (30, 60), 1.2), ((0, 24), (80, 83), 0.5)),
    "edge of the panel": transmissions(BODY) * static(((0, 24), (0, 1), 2), ((0, 2), (0, 96), 2)),
    "starved": transmissions(BODY) * static(((8, 16), (40, 50), 12)),
    "metal": transmissions(BODY + METAL),
    "plates": transmissions(PLATES),
    "wider than the panel": transmissions(WIDE),
    "few views": transmissions(BODY, views=16),
    "few photons through pores": transmissions(PORES),
}


@pytest.mark.parametrize("photons", [None, 1e5, 1e3, 30])
@pytest.mark.parametrize("name", SCANS)
def test_sharp_edges_noise_and_starvation_are_no_faults(name, photons):
    """Edges of the object, of a table and of plates, metal, and pixels with few photons."""
    light = torch.from_numpy((grey(SCANS[name], photons) - DARK) / BEAM).float()
    assert not wrong_in_views(light).any()
    images = light.swapaxes(0, 1) if light.shape[1] == 1 else light
    assert not zingers(images).any()


@pytest.mark.parametrize("width", [3, 10])
@pytest.mark.parametrize(
    ("place", "value"), [((0, 50), 1.0), ((0, 50), 0.4), ((0, 50), 2.0), ((6, 0), 0.4), ((6, 0), 2)]
)
def test_gaps_between_modules_are_found(place, value, width):
    """Columns, or rows, of one value in all views where the object passes. Also tried: without
    noise, 4 columns. Not told: gaps as dark as metal on the axis, rows as bright as air, which
    may lie between parts of the object, and the panel's borders, which have one side.
    """
    values, gap = grey(transmissions(BODY), 1e4), np.zeros((ROWS, COLUMNS), bool)
    gap[:, place[1] : place[1] + width] = place[1] > 0
    gap[place[0] : place[0] + width] |= place[0] > 0
    values[:, gap] = DARK + BEAM * value
    found = wrong_in_views(torch.from_numpy((values - DARK) / BEAM).float()).numpy()
    height = slice(4, 20) if value == 1 else slice(None)  # of the object, which may be as dark
    assert found[height][gap[height]].mean() > 0.95 and not found[~gap].any()


def test_a_pixel_far_below_zero_does_not_hide_others(tmp_path):
    """Its transmission of stored integrals would overflow. Also tried: +200, one view alone."""
    views = -np.log(transmissions(BODY)).astype("f4")
    views[:, 3, 40] = -200
    views[:, 3, 60] = 5
    np.save(tmp_path / "views.npy", views)
    with pytest.warns(UserWarning, match=r"2 of 2304 pixels .*\(2 other pixels\)"):
        bad = opened(tmp_path / "views.npy", kind="integrals").bad
    assert bad[3, 40] and bad[3, 60]


def broken(photons):
    """A scan with stuck columns, two of them neighbours, a stuck row, and a stuck, a hot and an
    unequal pixel; and where these are.
    """
    values, wrong = grey(transmissions(BODY), photons), np.zeros((ROWS, COLUMNS), bool)
    for place, value in (
        (np.s_[:, 30], 0.0),
        (np.s_[:, 40], 1.25),
        (np.s_[:, 60:62], 0.5),
        (np.s_[18], 0.2),
        (np.s_[5, 50], 0.8),
    ):
        values[:, *place if isinstance(place, tuple) else (place,)] = DARK + BEAM * value
        wrong[place] = True
    values[:, 7, 70] += 0.6 * BEAM
    values[:, 8, 66] = DARK + 0.6 * (values[:, 8, 66] - DARK)
    wrong[7, 70] = wrong[8, 66] = True
    return values.clip(0, 65_535).astype("u2"), torch.from_numpy(wrong)


@pytest.mark.parametrize("photons", [1e5, 1e4])
def test_stuck_hot_and_unequal_pixels_are_found_in_the_views_alone(photons, tmp_path):
    """They have no weight, and the log names them by their numbers on disk."""
    values, wrong = broken(photons)
    np.save(tmp_path / "scan.npy", values)
    options = {"dark": DARK, "flat": DARK + BEAM}
    words = (
        r"scan.npy: \d+ of 2304 pixels are dead, hot or stuck \(columns 30, 40, 60, 61, row 18, 3"
    )
    with pytest.warns(UserWarning, match=words):
        back = opened(tmp_path / "scan.npy", **options).whole()
    assert torch.equal(back.mask, ~wrong.expand_as(back.mask))
    part = {"columns": [10, 90], "flip_columns": True, "flip_rows": True}
    with pytest.warns(UserWarning, match=r"\(columns 30, 40, 60, 61, row 18, 3 other"):
        assert opened(tmp_path / "scan.npy", **options, **part).bad.sum() == wrong[:, 6:86].sum()
    with pytest.warns(UserWarning, match="transmission of at most"):
        assert opened(tmp_path / "scan.npy", **options, find_bad_pixels=False).whole().mask.all()


def test_filled_pixels_are_near_the_right_views(tmp_path):
    """Filtered back-projection takes the filled values: a column at -0.4 is an error no longer."""
    right = transmissions(BODY)
    values = grey(right, None)
    values[:, :, 30] = DARK + BEAM * math.exp(0.4)
    np.save(tmp_path / "scan.npy", values.clip(0, 65_535).astype("u2"))
    with pytest.warns(UserWarning, match=r"24 of 2304 pixels .*\(column 30\)"):
        back = opened(tmp_path / "scan.npy", dark=DARK, flat=DARK + BEAM).whole()
    expected = torch.from_numpy(-np.log(right)).float()
    off = (back.views - expected).abs()[:, :, 30]
    assert off.mean() < 0.03 and not back.mask[:, :, 30].any()


@pytest.mark.parametrize("hot", [False, True])
def test_pixels_that_fields_show_to_be_wrong_are_left_out(hot, tmp_path):
    """A pixel that is stuck in flat field and views alike divides to one without a dark field; one
    is hot in the dark field. Unequal gains, and the steps of a collimator, are not wrong.
    """
    rng = np.random.default_rng(2)
    flat = BEAM * rng.normal(1, 0.1, (ROWS, COLUMNS)).clip(0.75, 1.25)
    flat[:, 70:] *= 0.3
    dark = np.full((ROWS, COLUMNS), DARK)
    values = dark + flat * transmissions(BODY)
    (dark if hot else flat)[5, 40] = 9000
    values[:, 5, 40] = 9000 + hot * values[:, 5, 40]
    for name, image in (("dark", dark), ("flat", flat + (hot and dark)), ("scan", values)):
        np.save(tmp_path / f"{name}.npy", image.clip(0, 65_535).astype("u2"))
    fields = {"flat": tmp_path / "flat.npy", "dark": tmp_path / "dark.npy" if hot else 0}
    with pytest.warns(UserWarning, match=r"1 of 2304 pixels .*\(one other pixel\)"):
        bad = opened(tmp_path / "scan.npy", **fields).bad
    assert bad[5, 40] and bad.sum() == 1


def test_a_mask_of_bad_pixels_is_an_image_or_an_array(tmp_path):
    """Also of integrals and counts, and of one bit per pixel, as views are not; another size,
    several images or other values are refused.
    """
    views = np.random.default_rng(1).uniform(0.5, 1, (3, 6, 8)).astype("f4")
    np.save(tmp_path / "views.npy", views)
    mask = np.zeros((6, 8), "u1")
    mask[1, 2] = mask[:, 5] = 1
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    Pillow.fromarray(255 * mask).save(tmp_path / "mask.png")
    np.save(tmp_path / "mask.npy", mask.astype(bool))
    tifffile.imwrite(tmp_path / "bits.tif", mask.astype(bool))
    Pillow.fromarray(mask.astype(bool)).save(tmp_path / "packed.tif", compression="packbits")
    Pillow.fromarray(mask.astype(bool)).save(tmp_path / "bits.png")
    for name in ("mask.tif", "mask.png", "mask.npy", "bits.tif", "packed.tif", "bits.png"):
        for kind in ("integrals", "counts"):
            scan = opened(tmp_path / "views.npy", kind=kind, bad_pixels=tmp_path / name)
            with pytest.warns(UserWarning, match=r"7 of 48 .*\(column 5, one other pixel\)"):
                back = scan.whole()
            right = torch.from_numpy(mask == 0)
            assert torch.equal(back.mask, right.expand_as(back.mask))
            assert torch.equal(back.views[:, right], torch.from_numpy(views)[:, right])
            assert back.views[0, 1, 2].item() == pytest.approx(
                views[0, [0, 2, 1, 1], [2, 2, 1, 3]].mean(), rel=1e-6
            )
    for name in ("bits.tif", "packed.tif", "bits.png", "mask.npy"):
        with pytest.raises(Refused, match="integers or floats, got bool"):
            opened(tmp_path / name)
    for wrong, words in (
        (mask[:5], r"the views' \(6, 8\) pixels .*, got \(5, 8\)"),
        (np.arange(48, dtype="u1").reshape(6, 8), r"0 \(good\) and 1 \(bad\), got"),
        (mask + 1, r"0 \(good\) and 1 \(bad\), got"),
        (np.stack([mask, mask]), "one image|the views'"),
    ):
        for name in ("wrong.tif", "wrong.npy"):
            tifffile.imwrite(tmp_path / name, wrong) if "tif" in name else np.save(
                tmp_path / name, wrong
            )
            with pytest.raises(Refused, match=words):
                opened(tmp_path / "views.npy", kind="integrals", bad_pixels=tmp_path / name).whole()
    np.save(tmp_path / "all.npy", mask == 0)
    with pytest.raises(Refused, match="at least half of the pixels to measure, got 41 bad"):
        opened(tmp_path / "views.npy", kind="integrals", bad_pixels=tmp_path / "all.npy").whole()


def test_a_great_share_of_the_pixels_is_not_left_out_by_the_views_alone(tmp_path):
    """An eighth of all pixels is stuck: they are used, which is said."""
    values = grey(transmissions(BODY), 1e4)
    values[:, :, 1::8] = 3000
    np.save(tmp_path / "scan.npy", values.clip(0, 65_535).astype("u2"))
    with pytest.warns(UserWarning, match="too many to be single wrong ones"):
        assert not opened(tmp_path / "scan.npy", dark=DARK, flat=DARK + BEAM).bad.any()


@pytest.mark.parametrize("rows", [1, 24])
def test_zingers_are_found_filled_and_left_out(rows, tmp_path):
    """Bright pixels of single views, also two next to each other; their number is said, and blocks
    of views give what all views give.
    """
    light = transmissions(BODY, rows)
    rng = np.random.default_rng(3)
    hit = np.zeros(light.shape, bool)
    hit[tuple(rng.integers(0, n, 40) if n > 24 else np.full(40, n // 2) for n in light.shape)] = 1
    hit[:, :, [0, -1]] = False
    values = grey(light, 1e4)
    values[hit] += BEAM * rng.uniform(0.4, 1, hit.sum())
    pair = (20, rows // 2, 50), (20, rows // 2, 51)
    for place, extra in zip(pair, (0.9, 0.5), strict=True):
        values[place] += BEAM * extra
        hit[place] = True
    np.save(tmp_path / "scan.npy", values.clip(0, 2**18).astype("u4"))
    scan = opened(tmp_path / "scan.npy", dark=DARK, flat=DARK + BEAM)
    with pytest.warns(UserWarning, match=r"\d+ pixels of 64 views .*\(zingers\)"):
        back = scan.whole()
    assert (
        back.odd["zingers"] == (~back.mask).sum()
        and not (~back.mask & ~torch.from_numpy(hit)).any()
    )
    assert back.odd["zingers"] > 0.9 * hit.sum() and not any(back.mask[place] for place in pair)
    assert (back.views + torch.from_numpy(light).log()).abs()[~back.mask].mean() < 0.15
    for first, last in ((0, 1), (19, 22), (63, 64)):
        part = scan.read(first, last)
        assert torch.equal(part.mask, back.mask[first:last])
        assert torch.equal(part.views, back.views[first:last])


@pytest.mark.parametrize("method", ["gains", "sorting"])
def test_rings_of_unequal_pixels_are_removed(method, tmp_path):
    """Gains of columns that no flat field corrects: the second differences of their error, which
    make rings, fall to 60 % at least; of equal pixels "gains" changes nothing.
    """
    if method == "sorting":
        pytest.importorskip("algotom")
    right = transmissions([(3, -4, 35, 0.02, 9), (15, 10, 6, 0.05, 9), (-20, 5, 3, 0.1, 9)], 3)
    gain = np.random.default_rng(4).normal(1, 0.03, COLUMNS)
    options = {"dark": DARK, "flat": DARK + BEAM}

    def errors(gain, **more):
        np.save(tmp_path / "scan.npy", grey(right * gain, 1e6).astype("u2"))
        scan = opened(tmp_path / "scan.npy", **options, **more)
        off = scan.whole().views.double() + torch.from_numpy(right).log()
        assert torch.equal(scan.read(5, 9).views, scan.whole().views[5:9])
        level = off.mean(dim=0)
        return (level.diff(n=2).std() / 2).item(), off.std().item()

    (stripes, total), (fewer, less) = errors(gain), errors(gain, rings=method)
    assert fewer < 0.6 * stripes and less < 0.9 * total
    if method == "gains":
        assert errors(1, rings=method)[1] < 1.1 * errors(1)[1]
    right, few = right[:15], right[:, :, 40:44]
    with pytest.raises(Refused, match="16 views of more than 4 columns .*, got 15 of 96"):
        errors(1, rings=method)
    right = few
    with pytest.raises(Refused, match="got 64 of 4"):
        errors(gain[40:44], rings=method)
