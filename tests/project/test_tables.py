"""The tables of the pages are those of their CSV files: scripts/docs/tables.py."""

import re
from pathlib import Path

import pytest

from scripts.docs import tables

QUERY = "select method, printf('%.1f', avg(psnr)) as [PSNR dB] from [results.csv] group by method"
WRITTEN = """<!-- table
{query}
-->

| method | PSNR dB |
| --- | ---: |
| fdk | 20.5 |
| sirt |  |

<!-- end table -->
"""
ROWS = re.compile(r"^\|.*\|\n\|[-:| ]+\|\n((?:\|.*\|\n)+)", re.M)
NUMBER = re.compile(r"[-+]?[\d.][\d.,e+-]*( ?%| [a-zA-Z/^\d]{1,6})?")


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page with one table; the PSNR of one method is missing."""
    (tmp_path / "results.csv").write_text("method,psnr\nfdk,20.25\nfdk,20.75\nsirt,nan\n")
    file = tmp_path / "README.md"
    file.write_text("Before\n\n" + WRITTEN.format(query=QUERY) + "\nAfter\n")
    return file


def test_every_table_of_every_page_matches_its_csv():
    assert [*tables.differing()] == []


def test_an_up_to_date_page_is_not_changed(page: Path):
    assert tables.differing(page.parent) == {}


@pytest.mark.parametrize(
    ("old", "new"), [("20.5", "20.6"), ("| sirt |  |\n", ""), ("PSNR dB |\n| ---", "dB |\n| ---")]
)
def test_an_altered_table_is_found_and_corrected(old: str, new: str, page: Path):
    text = page.read_text()
    page.write_text(text.replace(old, new))
    assert page.read_text() != text
    assert tables.differing(page.parent) == {page: text}


def test_an_altered_csv_is_found(page: Path):
    csv = page.parent / "results.csv"
    csv.write_text(csv.read_text().replace("20.25", "20.45"))
    assert "| fdk | 20.6 |" in tables.differing(page.parent)[page]


def test_figures_of_several_seeds_have_a_mean_and_a_standard_deviation(page: Path):
    spread = QUERY.replace("'%.1f', avg(psnr)", "'%.2f ± %.2f', avg(psnr), stdev(psnr)")
    text = tables.written(WRITTEN.format(query=spread), page.parent)
    assert "| fdk | 20.50 ± 0.35 |" in text and "| sirt |  |" in text


@pytest.mark.parametrize(
    ("query", "message"),
    [
        (QUERY.replace("psnr", "psrn"), "no such column: psrn"),
        (QUERY.replace("results", "other"), r"No such file.*other\.csv"),
        (QUERY.replace("avg(psnr)", '"psrn"'), "name of a column in brackets"),
        (QUERY.replace("avg(psnr)", "method"), "raised exception"),
        (QUERY.replace("group by", "where psnr > 30 group by"), "no row is found"),
        (QUERY.replace("select", "choose"), "syntax error"),
    ],
)
def test_a_query_that_fails_is_an_error_that_names_the_page(query, message, page: Path):
    page.write_text(WRITTEN.format(query=query))
    with pytest.raises(ValueError, match=rf"README\.md: (?s:.*){message}"):
        tables.differing(page.parent)


def test_a_query_in_a_file_has_the_table_of_one_in_the_page(page: Path):
    (page.parent / "study.sql").write_text(QUERY + "\n")
    page.write_text(page.read_text().replace(f"table\n{QUERY}\n", "table study.sql "))
    assert tables.differing(page.parent) == {}
    text = page.read_text()
    page.write_text(text.replace("20.5", "20.6"))
    assert tables.differing(page.parent) == {page: text}
    (page.parent / "study.sql").unlink()
    with pytest.raises(ValueError, match=r"README\.md: .*No such file.*study\.sql"):
        tables.differing(page.parent)


def test_a_row_of_a_csv_that_is_cut_off_is_an_error(page: Path):
    csv = page.parent / "results.csv"
    csv.write_text(csv.read_text().replace("sirt,nan", "sirt"))
    with pytest.raises(ValueError, match=r"README\.md: Incorrect number of bindings"):
        tables.differing(page.parent)


@pytest.mark.parametrize("other", ["<!-- end table -->", "| sirt |  |"])
def test_a_table_without_an_end_or_with_text_in_it_is_an_error(other: str, page: Path):
    page.write_text(page.read_text().replace(other, "Words."))
    with pytest.raises(ValueError, match=r"README\.md: a table is not followed by"):
        tables.differing(page.parent)


SAYS = "<!-- says\nselect printf('%.1f dB, or %d', max(psnr), count(*)) from [results.csv]\n-->\n"


def test_the_words_of_a_query_are_in_a_sentence(page: Path):
    page.write_text(f"{page.read_text()}{SAYS}At most **20.8\ndB, or 3**.\n")
    assert tables.differing(page.parent) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SAYS + "At most 20.9 dB, or 3.\n", r"README\.md: no sentence has the words '20\.8 dB, or"),
        (SAYS + "<!-- 20.8 dB, or 3 -->\n", "no sentence has the words"),
        (SAYS.replace("count(*)", "max(nullif(method, method))"), "no sentence has the words None"),
        (SAYS.replace("psnr", "psrn"), "no such column: psrn"),
        (f" {SAYS}20.8 dB, or 3", "a table is not followed by"),
    ],
)
def test_other_words_than_those_of_a_query_are_an_error(text: str, message: str, page: Path):
    page.write_text(page.read_text() + text)
    with pytest.raises(ValueError, match=message):
        tables.differing(page.parent)


def test_no_page_has_a_table_of_figures_without_a_csv(root: Path):
    """That is one in which most cells but the first of each row are numbers."""
    pages = [page for pattern in tables.PAGES for page in root.glob(pattern)]
    found = []
    for page in pages:
        for rows in ROWS.findall(tables.TABLE.sub("", page.read_text())):
            lines = [line.strip("| ").split("|")[1:] for line in rows.splitlines()]
            cells = [cell.strip() for line in lines for cell in line]
            if sum(bool(NUMBER.fullmatch(cell)) for cell in cells) > len(cells) / 2:
                found.append(f"{page.relative_to(root)}: {rows.splitlines()[0]}")
    assert found == []
