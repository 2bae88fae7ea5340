"""Writes the table of `docs/file_formats.md` from the keys of every reader:
`python scripts/docs/file_keys.py`.

With `--check` it writes nothing, and exits with 1 if the page differs.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from mvrecon.core.files.keys import Key
from mvrecon.data import dicom, dicom_image, itk_headers, linked, nifti, nrrd_header, vgi
from mvrecon.data.projections import dicom_views, nexus_keys, png, rtk_images, tiff
from mvrecon.geometry.cameras.formats import nikon, rtk_xml, tigre
from mvrecon_spect.files import interfile_keys, nm_keys, nm_volume

PAGE = Path(__file__).resolve().parents[2] / "docs" / "file_formats.md"
TABLE = re.compile(
    r"(?<=<!-- keys by scripts/docs/file_keys\.py -->\n).*?(?=<!-- end keys -->)", re.S
)
FORMATS: dict[str, Sequence[Key]] = {
    "NIfTI": nifti.KEYS,
    "MetaImage": itk_headers.META_KEYS,
    "NRRD": nrrd_header.NRRD_KEYS,
    "VGStudio's .vgi": vgi.KEYS,
    "DICOM": dicom_image.KEYS,
    "DICOM CT": dicom.CT_KEYS,
    "DICOM projections": dicom_views.DICOM_KEYS,
    "DICOM NM (plugin `mvrecon-spect`)": nm_keys.KEYS,
    "DICOM NM volumes": nm_volume.KEYS,
    "TIFF": tiff.TIFF_KEYS,
    "PNG": png.PNG_KEYS,
    "HDF5 of beamlines": nexus_keys.KEYS,
    "Attributes of HDF5": linked.ATTRIBUTES,
    "EDF": rtk_images.EDF_KEYS,
    "Elekta's .his": rtk_images.HIS_KEYS,
    "Varian's .xim": rtk_images.XIM_KEYS,
    "Varian's .hnc, .hnd": rtk_images.VARIAN_KEYS,
    "RTK's XML": rtk_xml.KEYS,
    "TIGRE's JSON": tigre.KEYS,
    "Nikon's .xtekct": nikon.KEYS,
    "Interfile (plugin `mvrecon-spect`)": interfile_keys.KEYS,
    "Interfile projections": interfile_keys.CONTENT["projections"],
    "Interfile volumes": interfile_keys.CONTENT["volume"],
}


def table() -> str:
    """The table of all formats: one row for the keys of a format with the same use and note."""
    lines = ["", "| format | key | use |", "|---|---|---|"]
    for name, keys in FORMATS.items():
        rows: dict[str, list[str]] = {}
        for key in keys:
            allowed = ", ".join(map(str, key.allowed))
            use = f"{key.use} unless {allowed}" if allowed else key.use
            names = ", ".join(f"`{part}`" for part in key.name.replace("|", r"\|").split(", "))
            rows.setdefault(f"{use}: {key.note}" if key.note else use, []).append(names)
        lines += [f"| {name} | {', '.join(names)} | {use} |" for use, names in rows.items()]
    return "\n".join([*lines, "", ""])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if it differs")
    check, text = parser.parse_args().check, PAGE.read_text(encoding="utf-8")
    new, count = TABLE.subn(lambda _: table(), text)
    if count != 1:
        sys.exit(f"{PAGE}: expected one place for the table, got {count}")
    if check and new != text:
        print(f"{PAGE}: the table of keys differs; python scripts/docs/file_keys.py writes it")
        return 1
    if not check:
        PAGE.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
