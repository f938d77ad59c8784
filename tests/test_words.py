"""The prose of the documents is plain: short sentences, the field's words.

Prose is what stands outside code blocks, tables, made parts and the names of files and commands.
"""

import re
from collections.abc import Iterator

import pytest

from tests.golden.documents import CHECKOUT, DOCUMENTS, PART

MAX_WORDS = 30  # of a sentence; longer ones are read twice
BANNED = (
    "alike",
    "anew",
    "bear out",
    "bears out",
    "leave open",
    "leaves open",
    "mended",
    "no longer",
    "nowhere",
    "told apart",
    "used to",
)
TEXTS = {
    path.relative_to(CHECKOUT).as_posix(): path.read_text(encoding="utf-8")
    for path in DOCUMENTS
    if path.name != "CHANGELOG.md"  # tells how things came to be
}


def find_sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a document's prose, each on one line."""
    text = re.sub(r"^```.*?^```", "", PART.sub("", text), flags=re.MULTILINE | re.DOTALL)
    blocks: list[str] = [""]
    for line in text.splitlines():
        if re.match(r"\s*(?:[-*] |\d+\. |#|\||<!--|!\[|$)", line):
            blocks.append("")
        if not re.match(r"\s*(?:\||<!--|!\[|#)", line):
            blocks[-1] += f" {line.strip()}"
    for block in blocks:
        block = re.sub(r"`[^`]*`", "code", block)
        block = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", block)
        block = re.sub(r"\([^()]*\)", "", block)
        yield from (sentence.strip() for sentence in re.split(r"(?<=[.!?])\s+", block))


@pytest.mark.parametrize("name", TEXTS)
def test_sentences_of_the_documents_are_short(name: str) -> None:
    """Asides in brackets do not count; code is one word."""
    long = [s for s in find_sentences(TEXTS[name]) if len(s.split()) > MAX_WORDS]
    assert long == []


@pytest.mark.parametrize("name", TEXTS)
def test_documents_use_no_banned_word(name: str) -> None:
    prose = " ".join(find_sentences(TEXTS[name]))
    assert [word for word in BANNED if re.search(rf"\b{word}\b", prose, re.IGNORECASE)] == []
