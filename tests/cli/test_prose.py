"""Help, errors, other texts of the package and documents in plain words: phrases that may not occur in them."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from tract_dask.cli import main as cli

ROOT = Path(__file__).parents[2]

PHRASES = {
    r"stands? for": "is, means",
    r"whoever": "everyone who; or name the user",
    r"oneself": "one user",
    r"(is|are) told": "reports, shows",
    r"(this|that|it) is no(?! longer)": "this is not a",
    r"these are no(?! longer)": "these are not",
    r"(?<!there )is no(?! longer)": "is not a",
    r"of itself": "what the file holds",
    r"[\w ]+ does not fit\Z": "what is wrong with it",
    r"makes? no sense": "what is impossible, and why",
    r"(no|some)body": "no user, another program, an administrator",
    r"anew": "again",
    r"as (it is|they are)(?=[.,;:)]|\Z)": "unchanged",
    r"beside": "next to, besides, compared with",
    r"of (its|their|his) own": "a separate",
    r"mend(s|ed)?": "correct, repair",
    r"(or|,) say --": "use --",
    r"cannot be \w+ so": "which value is wrong",
    r"one asks": "name the user",
    r"is there (already|twice)(?! is)": "already exists, occurs twice",
    r"holds something else": "already holds other files",
    r"not what it was": "has changed",
    r"comes? to an end": "ends, finishes",
    r"gone on (with|from)": "continued",
}
"""What may not occur, by regular expression at a word's beginning, and what to write in its place."""

BANNED = {phrase: re.compile(rf"\b(?:{phrase})(?!\w)", re.IGNORECASE) for phrase in PHRASES}


def faults(text: str) -> list[str]:
    """The phrases of a text that may not occur, each with what is around it and what to write instead."""
    flat = " ".join(text.split())
    return [
        f"...{flat[max(0, found.start() - 30) : found.end() + 30]}...: write {PHRASES[phrase]}"
        for phrase, pattern in BANNED.items()
        for found in pattern.finditer(flat)
    ]


def texts(file: Path) -> Iterator[tuple[int, str]]:
    """The texts in a module that users may read, such as errors: all strings of several words but docstrings."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    parts |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr) and id(node) not in parts:
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            text = node.value
        else:
            continue
        if " " in text.strip():
            yield node.lineno, text


def commands(command: click.Command, *path: str) -> Iterator[tuple[str, click.Command]]:
    yield " ".join(path), command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, *path, name)


DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize(
    "document", [file for file in DOCUMENTS if file.name != "decisions.md"], ids=lambda file: file.name
)
def test_documents_are_in_plain_words(document):
    assert faults(document.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("path", "command"), list(commands(cli.main)), ids=lambda value: value if isinstance(value, str) else ""
)
def test_help_is_in_plain_words(path, command):
    helps = [command.help or "", *(getattr(option, "help", None) or "" for option in command.params)]
    assert [fault for text in helps for fault in faults(text)] == []


def test_errors_and_other_texts_are_in_plain_words():
    found = [
        f"{file.relative_to(ROOT)}:{line}: {fault}"
        for file in sorted((ROOT / "tract_dask").rglob("*.py"))
        for line, text in texts(file)
        for fault in faults(text)
    ]
    assert found == []


def test_phrases_are_found_where_they_are(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(
        '"""A place beside it."""\nraise InputError("the name does not fit", f"{x} is no size", "ok", "anew")\n'
    )
    assert [line for line, _ in texts(file)] == [2, 2]
    assert len([fault for _, text in texts(file) for fault in faults(text)]) == 2
    assert faults("there is no file, and it is no longer read; the work does not fit into memory") == []
    assert len(faults("the trial is told beside its field")) == 2
