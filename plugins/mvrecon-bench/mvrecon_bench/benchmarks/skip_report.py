"""Report of `bench=skip`: Markdown tables and plots, including the cases in which skipping is
slower.
"""

from collections.abc import Iterable, Mapping, Sequence

from mvrecon_bench.benchmarks.report import figure, legend, markdown
from mvrecon_bench.benchmarks.rows import Row, number
from mvrecon_bench.benchmarks.skip_tasks import DENSE

#: Columns of the tables, and their formats.
SHOWN = {
    "chosen": "",
    "ms": ".4g",
    "over_full": ".3g",
    "over_crop": ".3g",
    "build_ms": ".3g",
    "error": ".2g",
    "differing": ".0f",
    "psnr_loss": ".3f",
    "peak_mb": ".1f",
}
AGAINST = {
    "over_full": "over the full cube",
    "over_crop": "over the volume cropped by hand",
}


def label(row: Row) -> str:
    """Short label of a row's case and mode."""
    return f"{row['scene']} {row['rig']} {row['method']} {row['task']} {row['mode']}"


def table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """The scenes, every task with all its rows, the cases in which skipping is slower, and skipped
    rows.
    """
    good = [row for row in rows if row["status"] == "ok"]
    text = (
        "# What skipping gains\n\nTimes as fast as off on the full cube, and as off on the "
        "cropped volume.\n"
    )
    text += f"\n## Scenes\n\n{scenes(good)}"
    for task in dict.fromkeys(row["task"] for row in good):
        text += f"\n## {task}\n\n{lines(row for row in good if row['task'] == task)}"
    for over, against in AGAINST.items():
        text += f"\n## Where skipping loses {against}\n\n{lost(good, over)}"
    skipped = [(label(row), row["status"]) for row in rows if row["status"] != "ok"]
    text += f"\n## Left out\n\n{markdown(('case', 'status'), skipped, 2)}" if skipped else ""
    return text + legend(columns)


def scenes(rows: Sequence[Row]) -> str:
    """Description and fill fraction of every scene."""
    names = ("occupancy", "box", "support")
    ordered = sorted(
        rows, key=lambda row: "support" in row
    )  # the more specific description is last and wins
    facts = {
        (row["scene"], row["rig"], row["source"], row["grid"], row["views"]): row for row in ordered
    }
    cells = [(*key, *(figure(row, name, ".2%") for name in names)) for key, row in facts.items()]
    return markdown(("scene", "rig", "source", "grid", "views", *names), cells, 5)


def lines(rows: Iterable[Row]) -> str:
    """A table of rows."""
    head = ("scene", "rig", "method", "mode")
    cells = [
        (*(row[name] for name in head), *(figure(row, name, form) for name, form in SHOWN.items()))
        for row in rows
    ]
    return markdown((*head, *SHOWN), cells, 5)


def lost(rows: Iterable[Row], over: str) -> str:
    """A table of the rows that are slower than off by one of the columns of `AGAINST`, the worst
    first.
    """
    slower = [row for row in rows if row["mode"] not in DENSE and number(row, over) < 1]
    slower.sort(key=lambda row: row[over])
    names = ("scene", "rig", "method", "task", "mode", "chosen")
    cells = [(*(row[name] for name in names), figure(row, over, ".3g")) for row in slower]
    return markdown((*names, over), cells, 6) if cells else "Nowhere.\n"


def panels(rows: Iterable[Row]) -> dict[str, dict[str, list[tuple[str, float]]]]:
    """Task -> baseline -> (scene, speed-up) for every rig and method, in mode auto."""
    curves: dict[str, dict[str, list[tuple[str, float]]]] = {}
    for row in rows:
        if row["mode"] == "auto" and row["status"] == "ok":
            kinds = curves.setdefault(row["task"], {text: [] for text in AGAINST.values()})
            for name, text in AGAINST.items():
                if (times := number(row, name)) == times:
                    kinds[text].append((row["scene"], times))
    return {task: kinds for task, kinds in curves.items() if all(kinds.values())}
