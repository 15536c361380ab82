"""README is short and read once: its length and its sentences are counted."""

import re
from pathlib import Path

import numpy as np
import pytest
from pages import PAGES, README, ROOT, name, sentences

READ_ONCE = [README, *(page for page in PAGES if page.parent.name == "tutorials"), ROOT / "docs" / "index.md"]


def words(sentence: str) -> int:
    return len(re.findall(r"[\w'’./°-]*\w[\w'’./°-]*", sentence))


def test_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 130


@pytest.mark.parametrize("page", READ_ONCE, ids=name)
def test_sentences_are_short(page: Path) -> None:
    counts = {sentence: words(sentence) for sentence in sentences(page)}
    assert len(counts) > 5
    assert np.mean(list(counts.values())) <= 16
    assert not [sentence for sentence, count in counts.items() if count > 35]


LOOKED_UP = [page for page in PAGES if page not in READ_ONCE]


@pytest.mark.parametrize("page", LOOKED_UP, ids=name)
def test_no_sentence_of_any_page_runs_on(page: Path) -> None:
    counts = {sentence: words(sentence) for sentence in sentences(page)}
    assert np.mean([*counts.values()]) <= 22
    assert not [sentence for sentence, count in counts.items() if count > 45]
