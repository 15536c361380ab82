"""The report: one file that holds everything, and nothing that a name or a cell could smuggle in."""

from html.parser import HTMLParser

import pytest

from gavo_jax.errors import GavoError
from gavo_jax.output.report import Picture, Table, write_report

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="4" height="4"><rect width="4" height="4"/></svg>'


class Page(HTMLParser):
    """Elements with their attributes, and all text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def test_everything_is_in_the_one_file(tmp_path):
    figure = tmp_path / "figure.svg"
    figure.write_text(SVG)
    table = Table("drift, m/s", ("method", "drift"), [("ga", "0.0140"), ("pso", "0.0142")])
    path = tmp_path / "report.html"
    write_report(path, "A run", [table], [Picture("what it shows", figure)], {"seed": 7}, {"jax": "1.2"}, "In short.")
    page = Page(path.read_text())
    assert all(word in page.text for word in ("A run", "drift, m/s", "0.0142", '"seed": 7', "1.2"))
    assert len(page.all("table")) == 2 and len(page.all("tr")) == 3 + 2
    [image] = page.all("img")
    assert str(image["src"]).startswith("data:image/svg+xml;base64,") and image["alt"] == "what it shows"
    figure.unlink()
    assert not [name for _, attributes in page.elements for name in attributes if name in ("href", "onload")]
    [policy] = [meta for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert str(policy["content"]).startswith("default-src 'none'")


def test_text_stays_text(tmp_path):
    hostile = '<script>alert("x")</script>'
    path = tmp_path / "report.html"
    write_report(
        path, hostile, [Table(hostile, (hostile,), [(hostile,)])], [], {hostile: hostile}, {hostile: "1"}, hostile
    )
    page = Page(path.read_text())
    assert not page.all("script") and page.text.count(hostile) == 7


@pytest.mark.parametrize("name", ["missing.svg", "figure.pdf"])
def test_unusable_figure_leaves_no_report(tmp_path, name):
    (tmp_path / "figure.pdf").write_text("x")
    with pytest.raises(GavoError, match=name):
        write_report(tmp_path / "report.html", "", [], [Picture("", tmp_path / name)], {}, {})
    assert not (tmp_path / "report.html").exists()
