"""What `mkdocs build` does beside mkdocs.yml: entries of the navigation whose page is not there are left out."""

from pathlib import Path
from typing import Any


def on_config(config: Any) -> Any:
    """Keep the pages that exist."""
    config.nav = _existing(config.nav, Path(config.docs_dir))
    return config


def _existing(entry: Any, folder: Path) -> Any:
    """The part of the navigation that leads somewhere; None where nothing of it does."""
    if isinstance(entry, str):
        return entry if (folder / entry).is_file() else None
    if isinstance(entry, dict):
        kept = {title: _existing(value, folder) for title, value in entry.items()}
        return {title: value for title, value in kept.items() if value} or None
    return [kept for one in entry if (kept := _existing(one, folder))]
