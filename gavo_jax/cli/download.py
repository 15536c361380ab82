"""`gavo download`: downloads and unpacks a sequence of the TUM RGB-D benchmark."""

import os
import re
from pathlib import Path

from rich.progress import DownloadColumn, TransferSpeedColumn

from gavo_jax.cli.options import Download
from gavo_jax.datasets.download import SERVER
from gavo_jax.datasets.download import download as download_sequence
from gavo_jax.errors import GavoError, printable, shown
from gavo_jax.output.screen import progress_bar, say

SERVER_VARIABLE = "GAVO_TUM_SERVER"
"""Environment variable that names a mirror of the benchmark."""


def download(options: Download) -> int:
    """Download the sequence with a progress bar on standard error; print its folder."""
    # no shell expands ~ in environment files
    to = options.to or Path(os.path.expanduser(os.environ.get("GAVO_DATA") or "data"))
    server = os.environ.get(SERVER_VARIABLE) or SERVER
    if not re.match(r"https?://[^/]", server):
        raise GavoError(f"{SERVER_VARIABLE}: not the address of a server, https://…: {shown(server)}")
    with progress_bar(DownloadColumn(), TransferSpeedColumn()) as bar:
        task = bar.add_task(printable(options.name), total=None)

        def show(have: int, total: int | None) -> None:
            bar.update(task, completed=have, total=total)

        folder = download_sequence(options.name, to, server, show)
    say(str(folder))
    return 0
