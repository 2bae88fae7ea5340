"""Sets of OME-TIFF files, as Micro-Manager and Bio-Formats write them: OME's description of each
names all files, and says which page of which is which image.
"""

from html import escape

import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from tests.data.projections.conftest import VIEWS, grey, opened
from tests.data.projections.test_tiff import written

pytestmark = pytest.mark.filterwarnings("ignore:.* ExposureTime")
#: The number of the file of each view, in an order that no name has.
SHUFFLED = np.random.default_rng(3).permutation(VIEWS).tolist()
#: Exposure times of the views in ms.
TIMES = [100 + k for k in range(VIEWS)]


def described(pages, axis="T", binary=None, sizes=None):
    """OME's description of a set.

    Args:
        pages: file and page of each image.
        axis: axis along which images run; I: each is an image of its own.
        binary: name of the file that holds the description instead.
        sizes: sizes of the other axes, along which images run first.
    """
    if binary:
        return f'<OME xmlns="x"><BinaryOnly MetadataFile="{binary}" UUID="urn:uuid:1"/></OME>'
    sizes = {"Z": 1, "C": 1, "T": 1, **(sizes or {})}
    inner = int(np.prod([*sizes.values()]))
    if axis != "I":
        sizes[axis] = len(pages) // inner
    images = [""]
    for k, (name, page) in enumerate(pages):
        place = {"Z": 0, "C": 0, "T": 0}
        if axis != "I":
            place |= {other: k % inner for other, n in sizes.items() if other != axis and n > 1}
            place[axis] = k // inner
        first = " ".join(f'First{key}="{value}"' for key, value in place.items())
        the = " ".join(f'The{key}="{value}"' for key, value in place.items())
        images[-1] += (
            f'<TiffData IFD="{page}" {first} PlaneCount="1">'
            f'<UUID FileName="{escape(name)}">urn:uuid:{k}</UUID></TiffData>'
            f'<Plane {the} ExposureTime="{TIMES[k]}" ExposureTimeUnit="ms"/>'
        )
        images += [""] * (axis == "I" and k + 1 < len(pages))
    head = " ".join(f'Size{key}="{n}"' for key, n in sizes.items())
    whole = "".join(
        f'<Image ID="a"><Pixels Type="uint16" {head}>{image}</Pixels></Image>' for image in images
    )
    return f'<OME xmlns="x" UUID="urn:uuid:7">{whole}</OME>'


def stored(folder, names, axis="T", binary=None, sizes=None, start=""):
    """A set with the views of `grey` in files of these names, pages of one name in a row; the
    description has `start` before each.
    """
    folder.mkdir()
    pages = [(start + name, names[:k].count(name)) for k, name in enumerate(names)]
    for name in dict.fromkeys(names):
        values = grey()[[k for k, other in enumerate(names) if other == name]]
        text = described(pages, axis, binary if binary != name else None, sizes)
        text = text.replace('UUID="urn:uuid:7"', f'UUID="urn:uuid:{name}"')
        written(folder / name, values, description=text.encode())
    return folder


ONE_EACH = [f"a_{k}.ome.tif" for k in SHUFFLED]
SETS = {
    "along T": (ONE_EACH, {}),
    "along Z": (ONE_EACH, {"axis": "Z"}),
    "along C": (ONE_EACH, {"axis": "C"}),
    "images of their own": (ONE_EACH, {"axis": "I"}),
    "names without numbers": ([f"{'qwertyuiopas'[k]}.tif" for k in range(VIEWS)], {}),
    "names of several kinds": (["a.tif", *[f"a_{k}.tif" for k in range(1, VIEWS)]], {}),
    "escaped names": ([f"a & b{k}.tif" for k in SHUFFLED], {}),
    "described in one": (ONE_EACH, {"binary": ONE_EACH[4]}),
    "split": (["a.ome.tif"] * 7 + ["a_1.ome.tif"] * 5, {}),
    "split and alternating": (["a.ome.tif", "b.ome.tif"] * 6, {}),
    "of this folder": (ONE_EACH, {"start": "./"}),
    "of a folder": (ONE_EACH, {"start": "scan/"}),
    "of a folder of Windows": (ONE_EACH, {"start": "scan\\"}),
    "of a path that is not the shortest": (ONE_EACH, {"start": "scan/../scan//"}),
}


@pytest.mark.parametrize("case", SETS)
def test_a_set_is_read_in_the_order_that_ome_states(case, tmp_path):
    """Whatever the names are, in which no view has its number; exposures go with their views."""
    names, options = SETS[case]
    stack = open_projections(stored(tmp_path / "scan", names, **options))
    assert np.array_equal(stack.read(0, VIEWS).numpy(), grey())
    assert np.array_equal(stack.read(5, 9).numpy(), grey()[5:9])
    assert [float(text) for text in stack.stated["ExposureTime"]] == TIMES
    assert stack.names[0].startswith(names[0].split(".")[0])


#: Attributes of the elements of files of 7 and 5 pages.
RUNS = {
    "all pages of each file": 'FirstT="{first}"',
    "numbers of planes": 'IFD="0" FirstT="{first}" PlaneCount="{count}"',
    "numbers of planes alone": 'FirstT="{first}" FirstZ="0" PlaneCount="{count}"',
}


@pytest.mark.parametrize("sizes", ['SizeT="12"', 'DimensionOrder="XYZTC" SizeT="12" SizeC="1"'])
@pytest.mark.parametrize("run", RUNS)
def test_an_element_places_several_pages(run, sizes, tmp_path):
    """Along the axes in their order, in files whose names have another one. Without a page and a
    number, those up to the next element.
    """
    parts = {"b.tif": slice(0, 7), "a.tif": slice(7, 12)}
    body = "".join(
        f"<TiffData {RUNS[run].format(first=part.start, count=part.stop - part.start)}>"
        f'<UUID FileName="{name}">urn:uuid:1</UUID></TiffData>'
        for name, part in parts.items()
    )
    planes = "".join(f'<Plane TheT="{k}" ExposureTime="{k + 1}"/>' for k in range(VIEWS))
    text = f"<OME><Image><Pixels {sizes}>{body}{planes}</Pixels></Image></OME>"
    for name, part in parts.items():
        written(tmp_path / name, grey()[part], description=text.encode())
    stack = open_projections(tmp_path)
    assert np.array_equal(stack.read(0, VIEWS).numpy(), grey())
    assert stack.stated["ExposureTime"] == [f"{1000 * (k + 1)}" for k in range(VIEWS)]
    with pytest.raises(Refused, match="a place of each of its 8 images .* got 7"):
        written(tmp_path / "b.tif", grey()[:8], description=text.encode())
        open_projections(tmp_path)


def test_pages_of_an_element_along_two_axes_are_refused(tmp_path):
    body = "".join(
        f'<TiffData FirstT="{t}"><UUID FileName="{t}.tif">u</UUID></TiffData>' for t in (0, 3)
    )
    sizes = 'DimensionOrder="XYCTZ" SizeC="2" SizeT="6"'
    text = f"<OME><Image><Pixels {sizes}>{body}</Pixels></Image></OME>"
    for t in (0, 3):
        written(tmp_path / f"{t}.tif", grey()[2 * t : 2 * t + 6], description=text.encode())
    with pytest.raises(Refused, match="got 2 along C and 6 along T"):
        open_projections(tmp_path)


def test_a_companion_describes_its_files(tmp_path):
    folder = stored(tmp_path / "scan", ONE_EACH, binary="scan.companion.ome")
    pages = [(name, 0) for name in ONE_EACH]
    (folder / "scan.companion.ome").write_text(described(pages))
    assert np.array_equal(open_projections(folder).read(0, VIEWS).numpy(), grey())


def test_one_channel_of_a_set_is_chosen_by_a_pattern(tmp_path):
    """Of two running axes, the order of which a scan does not tell."""
    names = [f"a_C{k % 2}_T{SHUFFLED[k // 2]:02}.ome.tif" for k in range(VIEWS)]
    folder = stored(tmp_path / "scan", names, sizes={"C": 2})
    with pytest.raises(Refused, match="one axis.* got 2 along C and 6 along T; choose by pattern"):
        open_projections(folder)
    stack = open_projections(folder, pattern="*_C1_*")
    assert np.array_equal(stack.read(0, 6).numpy(), grey()[1::2])


def test_fields_of_a_set_beside_the_views_are_averaged(tmp_path):
    folder = stored(tmp_path / "scan", ONE_EACH)
    pages = [(f"flat_{k}.ome.tif", 0) for k in (10, 9)]
    for name, _ in pages:
        text = described(pages).encode()
        written(folder / name, np.full((6, 8), 60_000, "u2"), description=text)
    measured = opened(folder, dark=0.0)
    expected = -np.log(grey() / 60_000)
    assert np.allclose(measured.whole().views.numpy(), expected, atol=2e-6)


def renamed(folder):
    (folder / ONE_EACH[3]).rename(folder / "view.tif")


def without_one(folder):
    (folder / ONE_EACH[3]).unlink()


def with_another(folder):
    written(folder / "b_1.tif", grey()[0])


def of_two_sets(folder):
    other = [(f"b_{k}.ome.tif", 0) for k in range(2)]
    for name, _ in other:
        written(folder / name, grey()[0], description=described(other).encode())


def of_another_description(folder):
    pages = [(name, 0) for name in ONE_EACH[::-1]]
    written(folder / ONE_EACH[2], grey()[2], description=described(pages).encode())


def with_two_pages(folder):
    pages = [(name, 0) for name in ONE_EACH]
    written(folder / ONE_EACH[0], grey()[:2], description=described(pages).encode())


REFUSED = {
    renamed: r"files of the set that OME describes in .*|a place of each of its 1 images",
    without_one: r"expected in it the 12 files .* got 11 without \['a_.*gaps=true",
    with_another: r"got \['b_1.tif'\] as well; choose by pattern",
    of_two_sets: r"got \['b_0.ome.tif', 'b_1.ome.tif'\] as well; choose by pattern",
    of_another_description: "expected files of one set .* got another; choose by pattern",
    with_two_pages: "a place of each of its 2 images .* got 1; was it renamed",
}


@pytest.mark.parametrize("change", REFUSED)
def test_other_files_than_those_of_a_set_are_refused_with_a_cure(change, tmp_path):
    folder = stored(tmp_path / "scan", ONE_EACH)
    change(folder)
    with pytest.raises(Refused, match=REFUSED[change]):
        open_projections(folder)


@pytest.mark.parametrize("start", ["../", "/data/scan/", "C:\\scan\\", "scan/../../", "other/"])
def test_files_of_other_folders_are_no_set(start, tmp_path):
    """Also tried: some of them, in the folder itself or below."""
    folder = stored(tmp_path / "scan", ONE_EACH, start=start)
    with pytest.raises(Refused, match="a place of each of its 1 images .* got 0; .* moved"):
        open_projections(folder)
    pages = [(name, 0) for name in ("a.tif", f"{start}b.tif")]
    written(tmp_path / "a.tif", grey()[0], description=described(pages).encode())
    with pytest.raises(Refused, match=r"expected in it the 2 files .* without \['.*b.tif'\]"):
        open_projections(tmp_path)


def test_views_left_out_of_a_set_on_purpose(tmp_path):
    """Any with gaps=true, consecutive ones by a pattern; else the angles of all would shift."""
    folder = stored(tmp_path / "scan", [f"a_{k:02}.ome.tif" for k in range(VIEWS)])
    assert open_projections(folder, pattern="a_0*").n_views == 10
    (folder / "a_05.ome.tif").unlink()
    with pytest.raises(Refused, match="equal steps, got 4 and then 6"):
        open_projections(folder, pattern="a_*")
    stack = open_projections(folder, gaps=True)
    assert np.array_equal(stack.read(0, 11).numpy(), np.delete(grey(), 5, axis=0))


def test_one_file_of_a_set_is_read_alone(tmp_path):
    """With the pages and exposures that it has, as a flat field; a file that names itself alone may
    have any name.
    """
    folder = stored(tmp_path / "scan", ["a.ome.tif"] * 7 + ["b.ome.tif"] * 5)
    stack = open_projections(folder / "b.ome.tif")
    assert np.array_equal(stack.read(0, 5).numpy(), grey()[7:])
    assert [float(text) for text in stack.stated["ExposureTime"]] == TIMES[7:]
    text = described([("a.ome.tif", k) for k in range(VIEWS)])
    written(tmp_path / "c.tif", grey(), description=text.encode())
    stack = open_projections(tmp_path / "c.tif")
    assert np.array_equal(stack.read(0, VIEWS).numpy(), grey())
    assert stack.names[0] == "c 0"
