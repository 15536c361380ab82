"""Rewords tyro's output: one-line usage errors with a hint, and help pages that fit the screen."""

import difflib
import io
import itertools
import re
import shutil
import textwrap
from collections.abc import Sequence
from typing import TextIO

from gavo_jax.cli.options import COMMANDS, OPTIONS

NUMBER = r"(?:could not convert string to float|invalid literal for int\(\) with base 10): (?P<value>.*)"
UNION = r"no type matching .*(?P<kind>INT|FLOAT) could be instantiated from \[(?P<values>.*)\]\."
CHOICE = r"invalid choice (?P<value>.*) for argument '(?P<name>[^']*)'\. Expected one of \((?P<choices>.*)\)\."

ELSEWHERE = {
    "--method": ("--solver", "--algorithm", "--optimizer"),
    "--camera": ("--intrinsics", "--calibration", "--calib"),
    "--colour-topic": ("--rgb-topic", "--image-topic"),
    "--rate": ("--fps", "--framerate"),
    "--viewer": ("--gui", "--visualize", "--visualise", "--show"),
    "--frames": ("--limit", "--count", "--n-frames"),
}
"""Names that options have in other programs, by ours."""

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
HELP = ("-h", "--help")
HELP_OF_HELP = ("-h, --help", "show this help message and exit")
VERSION = ("--version", "print the version and exit")
"""Row of a help page on `--help`, and the one added for `--version`, which tyro lacks beside subcommands."""

USAGE_OF_ALL = "usage: gavo [-h] [--version] SUBCOMMAND ..."
"""Replaces tyro's usage, which lists all subcommands on one line; they follow in a table."""


class HelpPage(io.StringIO):
    """Captures what tyro prints for a stream, with colours and box lines only if the stream can show them."""

    def __init__(self, stream: TextIO) -> None:
        """Capture what is meant for `stream`."""
        super().__init__()
        self._stream = stream

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Encoding of the stream."""
        return self._stream.encoding

    def isatty(self) -> bool:
        """Whether the stream is a terminal."""
        return self._stream.isatty()

    def fitted(self) -> str:
        """Return the page with its text wrapped to the screen; that of the whole command lists `--version`, too."""
        width = shutil.get_terminal_size().columns
        lines = self.getvalue().splitlines()
        plain = [COLOUR.sub("", line) for line in lines]
        is_of_all = any(line.strip(" ╭─╮") == "subcommands" for line in plain)
        fitted = []
        for line, words in zip(lines, plain, strict=True):
            is_usage = words.startswith("usage:")
            if is_usage:
                line = USAGE_OF_ALL if is_of_all else words
            if words[:1].isalpha():
                indent = " " * 12 * is_usage
                line = textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False)
            fitted.append(line)
            if is_of_all and HELP_OF_HELP[1] in words:
                for told, ours in zip(HELP_OF_HELP, VERSION, strict=True):
                    words = words.replace(told, ours.ljust(len(told)))
                fitted.append(words)
        return "\n".join(fitted)


def asking_for_help(arguments: Sequence[str]) -> list[str]:
    """Return the arguments, or only SUBCOMMAND --help if they ask for that: tyro's page omits options given already."""
    if arguments and arguments[0] in COMMANDS and any(word in HELP for word in arguments[1:]):
        return [arguments[0], HELP[1]]
    return list(arguments)


def empty_argument(arguments: Sequence[str]) -> str | None:
    """Return a message if an argument, or an option's value, is empty or blank, else None.

    As a path it would be the current folder, or one whose name no message shows.
    """
    for before, argument in itertools.pairwise(("", *arguments)):
        if re.fullmatch(r"(--[\w-]+=)?\s*", argument):
            place = argument.strip().removesuffix("=") or before
            return f"{place}: empty argument; is a variable not set?".removeprefix(": ")
    return None


def fault_of_usage(box: str, arguments: Sequence[str]) -> str:
    """Return one line on what is wrong with the arguments.

    Args:
        box: Message of tyro, framed by lines, or by blanks if the screen's encoding has none.
        arguments: Arguments of the command.
    """
    lines = [line[2:].rstrip(" │") for line in box.splitlines() if line.startswith(("│ ", "  "))]
    first = list(itertools.takewhile(lambda line: line.strip(" ─-"), lines))
    said = " ".join((" ".join(first) or box).split())
    command = arguments[0] if arguments and arguments[0] in COMMANDS else ""
    return f"{_in_words(said, first, lines, arguments, command)} (see gavo {command}{' ' * bool(command)}--help)"


def _in_words(said: str, first: Sequence[str], lines: Sequence[str], arguments: Sequence[str], command: str) -> str:
    """Reword what the first lines of a box say; unusual faults are returned as they are."""
    if not command and (not arguments or not arguments[0].startswith("-")):
        return _no_command(arguments)
    if found := re.match(r"Unrecognized (?:or misplaced )?options: (\S+)", said):
        name = found[1].rstrip(",")
        if name in itertools.dropwhile(lambda word: word != "--", arguments):
            return f"{name}: comes after --, which ends the options"
        return _unknown(name, lines, command)
    if said.startswith("Missing from"):
        names = [words[1] for line in first if (words := re.match(r" {4}(\S+)", line))]
        return f"missing: {', '.join(names)}"
    if found := re.match(r"Missing value for argument '([^']*)'", said):
        return f"{found[1]}: a value is missing"
    if found := re.fullmatch(CHOICE, said):
        choices = re.findall(r"'([^']*)'", found["choices"])
        if "None" in choices:  # of an option that may be omitted; in arbitrary order
            choices = sorted({*choices} - {"None"})
        return f"{found['name']}: {found['value']} is not one of {', '.join(choices)}"
    if found := re.fullmatch(rf"Error parsing (?P<name>\S+): (?:{NUMBER}|{UNION})", said):
        is_whole = found["kind"] == "INT" or "int()" in said
        value = found["value"] or found["values"]
        return f"{found['name']}: must be a {'whole ' * is_whole}number, not {value}"
    return said


def _no_command(arguments: Sequence[str]) -> str:
    if not arguments:
        return f"missing command: expected one of {', '.join(COMMANDS)}"
    near = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(COMMANDS)}"
    return f"unknown command {arguments[0][:100]!r}; {hint}"


def _unknown(name: str, lines: Sequence[str], command: str) -> str:
    """Return the message on an unknown option, with a similar one of the command, or on a surplus argument."""
    if not name.startswith("-"):
        return f"unexpected argument {name[:100]!r}"
    like, similar = "", [own for own, names in ELSEWHERE.items() if name in names and own in OPTIONS.get(command, ())]
    for line in lines:
        if found := re.match(r" +(--[\w-]+)", line):
            like = found[1]
        elif like and line.endswith(f"in gavo {command} --help"):
            similar.append(like)
    return f"unknown option {name[:100]}" + (f"; did you mean {similar[0]}?" if similar else "")
