"""Reports in one HTML file: tables, figures, configuration and versions, without network access or scripts."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gavo_jax.errors import GavoError
from gavo_jax.output.files import json_text
from gavo_jax.trajectory import write_lines

REPORT = "report.html"
"""Name of the report in a folder of results."""

MEDIA_TYPES = {".svg": "image/svg+xml", ".png": "image/png"}

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 64rem; margin: 2rem auto;
       padding: 0 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: 1.5rem 0; font-variant-numeric: tabular-nums; font-size: 0.9rem; }
caption { text-align: left; color: #444; font-size: 0.9rem; padding: 0.3rem 0; max-width: 60rem; }
th, td { padding: 0.3rem 0.8rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid #444; }
tbody tr:nth-child(even) { background: #f5f5f5; }
figure { margin: 2rem 0; }
img { max-width: 100%; height: auto; }
pre { background: #f5f5f5; padding: 1rem; overflow-x: auto; font-size: 0.8rem; line-height: 1.35; }
@media print { details > * { display: block; } }
""".strip()


class Table(NamedTuple):
    """A table; cells are formatted by `str`."""

    caption: str
    """Meaning of the numbers, with units."""
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]


class Picture(NamedTuple):
    """A figure from a file."""

    caption: str
    """What the figure shows, with a definition of what is measured."""
    path: Path
    """SVG or PNG."""


def write_report(
    path: str | Path,
    title: str,
    tables: Sequence[Table],
    figures: Sequence[Picture],
    configuration: Mapping[str, Any],
    versions: Mapping[str, str],
    introduction: str = "",
) -> None:
    """Write the report atomically. It loads nothing: figures are inlined, and scripts are forbidden.

    Args:
        path: The HTML file.
        title: Heading.
        tables: Tables in order.
        figures: Figures in order; their files are read.
        configuration: What is needed to repeat the work; see `output.files.describe`.
        versions: Software versions by name.
        introduction: Paragraph below the title.

    Raises:
        GavoError: A figure cannot be read or is neither SVG nor PNG, or the report cannot be written.
    """
    settings = json_text(configuration, ensure_ascii=False)
    body = [
        f"<h1>{html.escape(title)}</h1>",
        *([f"<p>{html.escape(introduction)}</p>"] if introduction else []),
        *map(_table, tables),
        *map(_figure, figures),
        _table(Table("Versions", ("software", "version"), list(versions.items()))),
        f"<details><summary>Configuration</summary><pre>{html.escape(settings)}</pre></details>",
    ]
    write_lines(path, [_head(title), *body, "</body>", "</html>"])


def _head(title: str) -> str:
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>
{STYLE}
</style>
</head>
<body>"""


def _table(table: Table) -> str:
    def row(tag: str, cells: Sequence[Any]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in cells) + "</tr>"

    rows = "\n".join(row("td", cells) for cells in table.rows)
    return (
        f'<div class="wide"><table>\n<caption>{html.escape(table.caption)}</caption>\n'
        f"<thead>{row('th', table.columns)}</thead>\n<tbody>\n{rows}\n</tbody>\n</table></div>"
    )


def _figure(picture: Picture) -> str:
    """Inline a picture as a separate image, so that the identifiers inside several SVG files do not clash."""
    path = Path(picture.path)
    media_type = MEDIA_TYPES.get(path.suffix.lower())
    if media_type is None:
        raise GavoError(f"{path}: figures in a report must be {' or '.join(MEDIA_TYPES)}")
    try:
        data = base64.b64encode(path.read_bytes()).decode("ascii")
    except OSError as error:
        raise GavoError(f"{path}: cannot be read: {error.strerror or error}") from None
    caption = html.escape(picture.caption)
    return f'<figure>\n<img alt="{caption}" src="data:{media_type};base64,{data}">\n</figure>'
