"""Results of the benchmarks as records, and pages that quote them.

A record is a file of `benchmarks/records`: the tables that a benchmark printed, and with them its command, date,
machine and versions. `python benchmarks/NAME.py --record benchmarks/records/NAME.toml` writes one. Pages have places
for tables, between `<!-- records NAME -->` or `<!-- summary -->` and `<!-- end -->`; this command fills them:

    python benchmarks/records.py
    python benchmarks/records.py --check

With `--check` nothing is written, and the exit status is 1 if a page differs from the records.
"""

import argparse
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "benchmarks" / "records"
PAGES = ("README.md", "benchmarks/RESULTS.md", "docs/*.md")
"""Files with places for tables, from the repository's root."""
UNKNOWN = "–"
ALLOWED = next(
    requirement.specifier
    for line in tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    if (requirement := Requirement(line)).name == "jax"
)
"""The versions of JAX that the package allows."""


class Table(NamedTuple):
    """A printed table: the first column is text, the others are numbers as they were printed."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Record(NamedTuple):
    """One run of a benchmark."""

    benchmark: str
    command: str
    date: str
    machine: str
    versions: str
    tables: tuple[Table, ...]
    told: tuple[str, ...] = ()
    """Sentences that the benchmark printed beside its tables."""
    notes: tuple[str, ...] = ()
    """Remarks for the reader, written by hand."""


STRING = r"\"(?:[^\"\\\n]|\\.)*\""
"""Pattern of a TOML string on one line."""


def write_record(path: Path, record: Record) -> None:
    """Write a record; if it has no notes, it keeps those of the record that it replaces."""
    notes = record.notes or (read_record(path).notes if path.is_file() else ())
    entries = {**record._asdict(), "notes": notes}
    del entries["tables"]
    entries = {name: list(value) if isinstance(value, tuple) else value for name, value in entries.items() if value}
    tables = [
        {"title": t.title, "columns": list(t.columns), "rows": [list(row) for row in t.rows]} for t in record.tables
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_rows_on_a_line(tomli_w.dumps({**entries, "tables": tables})), encoding="utf-8")


def _rows_on_a_line(text: str) -> str:
    """Put each innermost list of a TOML text on one line, so that a table's row is a line of the file."""
    return re.sub(rf"\[\s*((?:{STRING},\s*)+)\]", lambda found: f"[{', '.join(re.findall(STRING, found[1]))}]", text)


def read_record(path: Path) -> Record:
    """Return what `write_record` wrote."""
    entries: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    tables = tuple(
        Table(table["title"], tuple(table["columns"]), tuple(tuple(row) for row in table["rows"]))
        for table in entries.pop("tables")
    )
    told, notes = (tuple(entries.pop(name, ())) for name in ("told", "notes"))
    return Record(**entries, tables=tables, told=told, notes=notes)


class Records:
    """All records of a folder, in the order of their names."""

    def __init__(self, folder: Path = FOLDER) -> None:
        self.by_name = {path.stem: read_record(path) for path in sorted(folder.glob("*.toml"))}

    def of(self, benchmark: str) -> list[Record]:
        """The records of a benchmark; the one of the same name comes first."""
        names = sorted(
            (name != benchmark, name) for name, record in self.by_name.items() if record.benchmark == benchmark
        )
        return [self.by_name[name] for _, name in names]

    def cell(self, benchmark: str, table: str, row: str, column: str) -> str:
        """A figure of the first record that has it, or a dash.

        Args:
            benchmark: Name of the benchmark.
            table: Text that the table's title contains.
            row: First cell of the row.
            column: Beginning of the column's heading.
        """
        return next((cell for _, cell in self.cells(benchmark, table, row, column)), UNKNOWN)

    def cells(self, benchmark: str, table: str, row: str, column: str) -> Iterator[tuple[Record, str]]:
        """Every figure that matches the arguments of `cell`, with its record."""
        for record in self.of(benchmark):
            for found in record.tables:
                headings = [i for i, heading in enumerate(found.columns) if i and heading.startswith(column)]
                for cells in found.rows:
                    if table in found.title and cells[0] == row and headings:
                        yield record, cells[headings[0]]


SUMMARY = (
    ("**gavo `ga`**", "ga"),
    ("gavo `ga`, preset `fast`", "ga:fast"),
    ("gavo `ga`, preset `wide`", "ga:wide"),
    ("gavo `pso`", "pso"),
    ("gavo `gauss-newton`", "gauss-newton"),
    ("gavo `adam`", "adam"),
    ("gavo `ga`, preset `paper`", "ga, paper"),
    ("the paper's GA, as the paper reports it", "printed"),
    ("OpenCV SIFT, PnP", "sift-pnp"),
    ("OpenCV ORB, PnP", "orb-pnp"),
    ("OpenCV RGB", "opencv-rgb"),
    ("OpenCV RGB-D", "opencv-rgbd"),
    ("Open3D colour", "open3d-color"),
    ("Open3D tensor, hybrid", "open3d-tensor-hybrid"),
    ("Open3D tensor, point to plane", "open3d-tensor-point-to-plane"),
)
"""Rows of README's table: the label, and the method's name in the records."""
OF_TABLE_1 = {"ga, paper": ("ga, paper", "m/s"), "printed": ("ga", "printed")}
"""Rows whose drift is from the paper's first experiment only: the row and the column of Table 1."""
CLIPS = ("fr1_xyz", "fr1_desk", "fr1_rpy")


MARKS = "†‡§¶"
"""Marks of README's figures that are of another version of JAX than most."""


class Figure(NamedTuple):
    """A figure of README's table, and the record that it is from; None for a dash."""

    text: str
    record: Record | None = None

    @property
    def version(self) -> str:
        """Version of JAX that it was measured with; empty if none is known."""
        return (self.record and jax_of(self.record)) or ""


def share_found(record: Record, share: str) -> str:
    """The share of motions found, marked if it is of all pairs; `benchmarks/basin.py` takes every fourth by default."""
    return f"{share} (all)" if "--step 1 " in record.command else share


def summary_figures(records: Records) -> list[list[Figure]]:
    """The figures of each row of README's table: drift on each clip, motions found over a wide baseline, and time."""

    def figure(*place: str) -> Figure:
        return next((Figure(text, record) for record, text in records.cells(*place)), Figure(UNKNOWN))

    rows = []
    for _, method in SUMMARY:
        if method in OF_TABLE_1:
            drift = figure("table1", "fr1_xyz", *OF_TABLE_1[method])
            drifts = [drift._replace(text=f"{float(drift.text):.4f}"), Figure(UNKNOWN), Figure(UNKNOWN)]
        else:
            drifts = [figure("drift", f"drift on {clip}", method, "m/s") for clip in CLIPS]
        found = figure("basin", "success rate on fr1_rpy", method, "10 frames")
        if found.record is not None:
            found = found._replace(text=share_found(found.record, found.text))
        rows.append([*drifts, found, figure("throughput", "fr1_xyz", method, "/ opencv-rgbd")])
    return rows


def summary(records: Records) -> Table:
    """README's table; figures of another version of JAX than most are marked."""
    marks = marks_of_versions(records)

    def marked(figure: Figure) -> str:
        return f"{figure.text} {marks.get(figure.version, '')}".rstrip()

    rows = zip(SUMMARY, summary_figures(records), strict=True)
    return Table("", ("", *CLIPS, "found", "time"), tuple((title, *map(marked, row)) for (title, _), row in rows))


def markdown(table: Table) -> str:
    """A table as Markdown."""
    rule = ["---", *["---:"] * (len(table.columns) - 1)]
    lines = [f"| {' | '.join(cells)} |" for cells in (table.columns, rule, *table.rows)]
    return "\n".join(lines)


def jax_of(record: Record) -> str | None:
    """Version of JAX that a record was measured with; None if it names none."""
    found = re.search(r"\bJAX ([\w.]+)", record.versions)
    return found[1].rstrip(".") if found else None


def ruled_out(record: Record) -> str | None:
    """A remark if a record comes from a version of JAX that the package does not allow, else None."""
    version = jax_of(record)
    if version is None or ALLOWED.contains(version, prereleases=True):
        return None
    return f"JAX {version} is ruled out: it can compute wrong numbers on a CPU. These figures await a new measurement."


def marks_of_versions(records: Records) -> dict[str, str]:
    """The mark of each version of JAX in README's table; that of most figures has none."""
    counts = Counter(figure.version for row in summary_figures(records) for figure in row if figure.version)
    return dict(zip([version for version, _ in counts.most_common()], ["", *MARKS], strict=False))


def sources_of_summary(records: Records) -> str:
    """A sentence that names the versions of JAX of README's figures."""
    parts = []
    for version, mark in marks_of_versions(records).items():
        remark = "" if ALLOWED.contains(version, prereleases=True) else ", which is ruled out"
        parts.append(f"{mark or 'Measured'} with JAX {version}{remark}")
    return "; ".join(parts) + "."


def section(records: Sequence[Record]) -> str:
    """The tables of a benchmark's records, with the source of each record."""
    parts = []
    for record in records:
        parts += [
            f"**{table.title}**\n\n{markdown(table)}" if table.title else markdown(table) for table in record.tables
        ]
        parts.append(f"*`{record.command}`. {record.date}; {record.machine}; {record.versions}.*")
        if remark := ruled_out(record):
            parts.append(remark)
        parts += (*record.told, *record.notes)
    return "\n\n".join(parts)


PLACE = re.compile(r"(<!-- (records|summary) ?([\w-]*) -->)\n.*?(<!-- end -->)", re.DOTALL)


def fill(text: str, records: Records) -> str:
    """A page with the records' tables in their places.

    Raises:
        ValueError: a place names a benchmark that has no record.
    """

    def insert(place: re.Match[str]) -> str:
        start, kind, name, end = place.groups()
        if kind == "records" and not records.of(name):
            raise ValueError(f"no record of {name!r}")
        if kind == "summary":
            inside = f"{markdown(summary(records))}\n\n{sources_of_summary(records)}"
        else:
            inside = section(records.of(name))
        return f"{start}\n\n{inside}\n\n{end}"

    return PLACE.sub(insert, text)


def pages(root: Path = ROOT) -> Iterator[Path]:
    """The files with places for tables."""
    for pattern in PAGES:
        yield from (path for path in sorted(root.glob(pattern)) if PLACE.search(path.read_text(encoding="utf-8")))


def stale_pages(root: Path = ROOT) -> dict[Path, str]:
    """The pages that differ from the records, with the text that they should have."""
    records = Records(root / "benchmarks" / "records")
    filled = {path: fill(path.read_text(encoding="utf-8"), records) for path in pages(root)}
    return {path: text for path, text in filled.items() if text != path.read_text(encoding="utf-8")}


def main() -> int:
    """Fill the pages, or print which are out of date."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; status 1 where a page is out of date")
    check = parser.parse_args().check
    stale = stale_pages()
    for path, text in stale.items():
        print(f"{path.relative_to(ROOT)}: {'not what the records say' if check else 'filled'}")
        if not check:
            path.write_text(text, encoding="utf-8")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
