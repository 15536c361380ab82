"""Links between pages lead somewhere, the reference has every public name, and the pages' figures are the records'."""

import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from pages import PAGES, ROOT, anchors, inline_commands, links, name
from PIL import Image

import gavo_jax as gavo


def names_of(module: ModuleType) -> list[str]:
    """What a module offers: names that it imports as themselves."""
    imported = re.findall(r"^from \S+ import (\w+) as \1$", inspect.getsource(module), re.MULTILINE)
    return [imported_name for imported_name in imported if not isinstance(getattr(module, imported_name), ModuleType)]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_inside_lead_somewhere(page: Path) -> None:
    for file, anchor in links(page):
        target = page if not file else (page.parent / file).resolve()
        assert target.exists(), file
        assert not anchor or anchor in anchors(target), f"{file}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_of_the_site_stay_in_it(page: Path) -> None:
    site = ROOT / "docs"
    for file, _ in links(page) if site in page.parents else ():
        assert not file or (page.parent / file).resolve().is_relative_to(site), file


def test_the_reference_has_every_public_name() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    documented = re.findall(r"^::: gavo_jax\.([\w.]+)$", pages, re.MULTILINE)
    actors = [f"datasets.rendered.actors.{name}" for name in ("box", "figure", "Sway", "Walk", "Swing")]
    returned = ["evaluation.RelativePoseError", "evaluation.ErrorSeries", "bodies.records.Body"]
    returned += ["odometry.metrics.RunMetrics", "mapping.mapper.Loops"]
    taken = ["datasets.live.frames.LiveDevice"]
    public = [*names_of(gavo), *(f"solvers.{name}" for name in names_of(gavo.solvers))]
    assert sorted(documented) == sorted([*public, *actors, *returned, *taken])
    for public in names_of(gavo):
        value = getattr(gavo, public)
        assert not callable(value) or value.__doc__, public


def test_every_page_is_in_the_navigation() -> None:
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"[\w/-]+\.md", str(yaml.safe_load(config)["nav"])))
    assert {str(page.relative_to(ROOT / "docs")) for page in PAGES if "docs" in page.parts[len(ROOT.parts)]} <= listed


def test_figures_on_pages_are_those_of_the_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    records = importlib.import_module("records")
    assert len(list(records.pages())) >= 2
    stale = [path.name for path in records.stale_pages()]
    assert not stale, "python benchmarks/records.py fills them"


def test_figures_are_drawn_from_the_records(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    folder = ROOT / "benchmarks" / "records"
    for benchmark in ("drift", "basin"):
        files = ",".join(map(str, sorted(folder.glob(f"{benchmark}*.toml"))))
        importlib.import_module(benchmark).main(recorded=files, figure=tmp_path)
        assert (tmp_path / f"{benchmark}.png").stat().st_size > 10_000
    records = importlib.import_module("records").Records()
    drawn = importlib.import_module("drift").medians(records.of("drift"))
    assert drawn["fr1_xyz"]["ga"][0, 0] == float(records.cell("drift", "drift on fr1_xyz", "ga", "m/s"))


def mark_of(picture: Path) -> str:
    """The digest of what a benchmark drew."""
    with Image.open(picture) as image:
        return image.info["drawn"]


def test_pictures_on_pages_are_of_the_present_records(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.chdir(ROOT)
    drawn = {"drift": "", "basin": ""}
    for command in inline_commands(ROOT / "docs" / "viewer.md"):
        for benchmark in drawn:
            if command.startswith(f"python benchmarks/{benchmark}.py --recorded"):
                recorded = command.split()[3]
                importlib.import_module(benchmark).main(recorded=recorded, figure=tmp_path)
                drawn[benchmark] = command
    for benchmark, command in drawn.items():
        now, shown = (mark_of(folder / f"{benchmark}.png") for folder in (tmp_path, ROOT / "docs"))
        assert now == shown, f"draw it again: {command}"


def test_a_record_reads_back_as_it_was_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    records = importlib.import_module("records")
    table = records.Table('a "quoted", title', ("", "x, y"), (("[one]", "1.0"), ("two", "–")))
    record = records.Record(
        "b", "python b.py", "2026-01-01", "a machine", "JAX 1", (table, table), ("Two.",), ("A note.",)
    )
    records.write_record(tmp_path / "b.toml", record)
    assert records.read_record(tmp_path / "b.toml") == record
    records.write_record(tmp_path / "b.toml", record._replace(date="2026-02-02", notes=()))
    assert records.read_record(tmp_path / "b.toml").notes == ("A note.",)
    assert records.Records(tmp_path).cell("b", "a", "[one]", "x") == "1.0"
    assert records.Records(tmp_path).cell("b", "a", "three", "x") == "–"


def test_troubleshooting_quotes_messages_that_there_are() -> None:
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "gavo_jax").rglob("*.py"))
    source = re.sub(r'"\s*\n\s*f?"', "", source)
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = [
        span for entry in re.findall(r"^\*\*(.+?)\*\*", page, re.MULTILINE) for span in re.findall(r"`(.+?)`", entry)
    ]
    assert len(quoted) > 10
    for message in quoted:
        for words in re.split(r"…|'NAME'|\.\.\.", message):
            assert words.strip() in source, message


def test_a_page_says_so_where_a_record_is_of_a_jax_that_is_ruled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    records = importlib.import_module("records")
    table = records.Table("t", ("", "x"), (("a", "1"),))
    old, new, none = (
        records.Record("b", "c", "2026-01-01", "m", versions, (table,))
        for versions in ("JAX 0.10.2, NumPy 2.4.6", "JAX 0.10.1, NumPy 2.4.6", "Open3D 0.20.0")
    )
    assert "JAX 0.10.2 is ruled out" in records.section([old])
    assert "ruled out" not in records.section([new, none])
    assert "JAX 0." in records.sources_of_summary(records.Records())


def test_readme_marks_figures_of_another_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    module = importlib.import_module("records")
    records = module.Records()
    timed, _ = next(records.cells("throughput", "fr1_xyz", "open3d-color", "/ opencv-rgbd"))
    for stem, record in records.by_name.items():
        version = "JAX 0.10.2" if record is timed else "JAX 0.10.1"
        records.by_name[stem] = record._replace(versions=re.sub(r"JAX [\d.]+", version, record.versions))
    row = next(row for row in module.summary(records).rows if row[0] == "Open3D colour")
    assert [cell.endswith(" †") for cell in row] == [False] * (len(row) - 1) + [True]
    assert module.sources_of_summary(records) == "Measured with JAX 0.10.1; † with JAX 0.10.2, which is ruled out."
