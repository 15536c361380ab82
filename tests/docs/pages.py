"""README and the documentation's pages as tests read them: blocks of code, links, sentences."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    """A block of code."""

    language: str
    code: str
    line: int
    """Of the page, from 1: where the code begins."""


def name(page: Path) -> str:
    """The page's path from the root, as tests are named."""
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[Block]:
    """The page's blocks of a language."""
    text = page.read_text(encoding="utf-8")
    found = (Block(match[1], match[2], text[: match.start(2)].count("\n") + 1) for match in FENCE.finditer(text))
    return [block for block in found if block.language == language]


def commands(page: Path) -> list[str]:
    """The page's commands, one each, without what chains them."""
    lines = (line for block in blocks(page, "sh") for line in block.code.splitlines())
    return [part.strip() for line in lines for part in line.split("&&") if part.strip() and not part.startswith("#")]


def inline_commands(page: Path) -> list[str]:
    """Commands that stand in a sentence, as `gavo …` or `python …`."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    found = (" ".join(span.split()) for span in re.findall(r"`((?:gavo|python) [^`]+)`", text))
    return [command for command in found if "…" not in command]


def links(page: Path) -> Iterator[tuple[str, str]]:
    """Targets of the page's links and pictures inside the repository: file and anchor."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not target.startswith(("http://", "https://", "mailto:")):
            file, _, anchor = target.partition("#")
            yield file, anchor


def anchors(page: Path) -> set[str]:
    """What the headings of a page are linked by."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def sentences(page: Path) -> list[str]:
    """The page's prose, sentence by sentence: no code, tables, headings, pictures and comments; an entry of a list
    ends a sentence."""
    text = FENCE.sub("\n\n", page.read_text(encoding="utf-8"))
    text = re.sub(r"<!--.*?-->", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"^(#|\||!\[).*$", "\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    paragraphs = re.split(r"\n\s*\n|^\s*[-*] ", text, flags=re.MULTILINE)
    split = (re.split(r"(?<=[.!?])[\s\"*)]+(?=\S)", " ".join(paragraph.split())) for paragraph in paragraphs)
    return [sentence for paragraph in split for sentence in paragraph if len(sentence.split()) > 1]
