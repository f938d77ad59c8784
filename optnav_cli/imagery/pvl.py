"""The part of PVL (parameter value language) that labels of ISIS cubes use.

Groups and objects with keywords; a value is a word, a quoted text, or a list in parentheses; units
in angle brackets are dropped; a hyphen at the end of a line joins a broken word.
"""

import re
from dataclasses import dataclass, field

from catalog.errors import DataError

Value = str | list[str]

_TOKEN = re.compile(r'"([^"]*)"|<[^>]*>|([(),=])|([^\s(),="<]+)')


@dataclass
class Block:
    """A group or object: its keywords and the blocks within it. Keyword names keep their case."""

    kind: str
    name: str
    keywords: dict[str, Value] = field(default_factory=dict)
    blocks: list["Block"] = field(default_factory=list)

    def find(self, kind: str, **keywords: str) -> "Block | None":
        """The first block below, at any depth, of this kind or name and with these keywords."""
        for block in self.blocks:
            matches = kind in (block.kind, block.name)
            if matches and all(block.keywords.get(key) == keywords[key] for key in keywords):
                return block
            deeper = block.find(kind, **keywords)
            if deeper is not None:
                return deeper
        return None

    def text(self, key: str) -> str:
        """A keyword's value as text. Raises DataError when it is missing or a list."""
        value = self.keywords.get(key)
        if not isinstance(value, str):
            raise DataError(f"label: {self.kind} {self.name} has no single value '{key}'")
        return value

    def number(self, key: str) -> float:
        """A keyword's value as a number. Raises DataError when it is none."""
        try:
            return float(self.text(key))
        except ValueError:
            raise DataError(f"label: {self.kind} {self.name}: '{key}' is no number") from None

    def numbers(self, key: str) -> list[float]:
        """A keyword's list of numbers; empty when the keyword is missing. Raises DataError."""
        value = self.keywords.get(key, [])
        try:
            return [float(item) for item in ([value] if isinstance(value, str) else value)]
        except ValueError:
            raise DataError(
                f"label: {self.kind} {self.name}: '{key}' is no list of numbers"
            ) from None


def parse_label(text: str) -> Block:
    """The label up to its `End`, as an unnamed block. Raises DataError when it does not nest."""
    tokens = _tokens(re.sub(r"-[ \t]*\r?\n\s*", "", text))
    root = Block("Label", "")
    open_blocks = [root]
    position = 0
    while position < len(tokens):
        word = tokens[position]
        if word == "End":
            break
        if word.startswith("End_"):
            if len(open_blocks) == 1:
                raise DataError(f"label: '{word}' ends nothing")
            open_blocks.pop()
            position += 1
            continue
        if tokens[position + 1 : position + 2] != ["="]:
            raise DataError(f"label: '{word}' has no value")
        value, position = _value(tokens, position + 2)
        if word in ("Group", "Object"):
            block = Block(word, str(value))
            open_blocks[-1].blocks.append(block)
            open_blocks.append(block)
        else:
            open_blocks[-1].keywords[word] = value
    if len(open_blocks) > 1:
        raise DataError(f"label: {open_blocks[-1].kind} {open_blocks[-1].name} does not end")
    return root


def _tokens(text: str) -> list[str]:
    tokens = []
    for match in _TOKEN.finditer(text):
        quoted, mark, word = match.groups()
        if quoted is not None:
            tokens.append(" ".join(quoted.split()))
        elif mark or word:
            tokens.append(mark or word)
    return tokens


def _value(tokens: list[str], position: int) -> tuple[Value, int]:
    if position >= len(tokens):
        raise DataError("label: it breaks off")
    if tokens[position] != "(":
        return tokens[position], position + 1
    items: list[str] = []
    for end in range(position + 1, len(tokens)):
        if tokens[end] == ")":
            return items, end + 1
        if tokens[end] != ",":
            items.append(tokens[end])
    raise DataError("label: a list does not end")
