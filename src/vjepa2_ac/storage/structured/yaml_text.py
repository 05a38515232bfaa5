"""YAML from untrusted files.

Nothing is executed. Keys are text, as written; a date is text, too, and 1e-4 is a number. Refused are surprising
values: duplicate keys, numbers with a leading zero or with colons (which YAML reads as a different number), numbers out
of range; and what would take too long: too many values once aliases are expanded, or values nested too deep.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import yaml
from yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode, SequenceNode
from yaml.reader import ReaderError

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured.messages import shown
from vjepa2_ac.storage.structured.nesting import MOST_DEPTH
from vjepa2_ac.storage.structured.yaml_scalars import NotAValueError, plain_value, tagged_value

MOST_VALUES = 100_000

_CORE = "tag:yaml.org,2002:"
_MERGE = "<<"
_TEMPLATE = "Fill in the template; or put text with braces in quotes"
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_KINDS = {MappingNode: "map", SequenceNode: "seq"}


def parse_yaml(text: str, *, where: str) -> Any:
    """Return the values of a YAML document: mappings with keys of text, lists, text, numbers, truth values, None.

    Raises:
        InputError: It is not YAML, or not within the bounds; names line and column.
    """
    try:
        node = _composed(text)
        return None if node is None else _Values().of(node)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{where}: line {mark.line + 1}, column {mark.column + 1}" if mark else where
        line = text.splitlines()[mark.line] if mark and mark.line < len(text.splitlines()) else ""
        fix = error.note or (_TEMPLATE if "{{" in line or "{%" in line else "")
        found = f"not YAML: {', '.join(part for part in (error.context, error.problem) if part)}"
        raise InputError(where=place, found=found, fix=fix) from None
    except ReaderError as error:
        place = f"{where}: line {text.count(chr(10), 0, error.position) + 1}"
        found = f"not YAML: the control character {chr(error.character)!r}"
        raise InputError(where=place, found=found, needed="text") from None


@lru_cache(maxsize=4)
def _composed(text: str) -> Node | None:
    """Return a document as nodes, which nobody changes: a command reads the config of its run several times."""
    return _Composed(text).get_single_node()


class _Composed(yaml.SafeLoader):
    """A document as nodes, bounded in number and depth; scalars are not resolved here, and nothing is constructed."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._count = 0

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a node and those in it."""
        self._depth += 1
        self._count += 1
        _require_bounds(self._depth, self._count, parent)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def resolve(self, kind: type[Node], value: Any, implicit: Any) -> str:  # noqa: ARG002 - PyYAML's
        """Return no tag: only explicit tags count."""
        return ""


class _Values:
    """Converts nodes to values. Aliases are expanded, and counted, each time."""

    def __init__(self) -> None:
        self._count = 0
        self._around: list[Node] = []

    def of(self, node: Node) -> Any:
        """Return the value of a node."""
        self._count += 1
        _require_bounds(len(self._around), self._count, node)
        if isinstance(node, ScalarNode):
            return _scalar(node)
        if any(node is outer for outer in self._around):
            raise _wrong("an alias within what it stands for", node)
        if not isinstance(node, CollectionNode) or node.tag not in {"", _CORE + _KINDS[type(node)]}:
            raise _wrong(f"the tag {_tag(node)}", node, "Leave it out")
        self._around.append(node)
        value = self._mapping(node) if isinstance(node, MappingNode) else [self.of(inner) for inner in node.value]
        self._around.pop()
        return value

    def _mapping(self, node: MappingNode) -> dict[str, Any]:
        """Return keys and values; the mapping's own keys override merged ones."""
        merged: dict[str, Any] = {}
        own: dict[str, Any] = {}
        given: set[str] = set()
        for key, value in node.value:
            name = _key(key)
            if name in given:
                raise _wrong(f"key {name!r} is given twice", key, "Write <<: [*one, *other]" if name == _MERGE else "")
            given.add(name)
            if name == _MERGE and key.style is None:
                for source in _mappings(value):
                    merged = self.of(source) | merged  # the first one counts
            else:
                own[name] = self.of(value)
        return merged | own


def _key(node: Node) -> str:
    if not isinstance(node, ScalarNode):
        raise _wrong("a key that is a mapping or a list itself, as in {{ NAME }}", node, _TEMPLATE)
    return _text(node)


def _mappings(node: Node) -> Iterator[Node]:
    """Yield the mappings that << names: one, or each of a list."""
    for inner in node.value if isinstance(node, SequenceNode) else [node]:
        if not isinstance(inner, MappingNode):
            raise _wrong("<< of something that is neither a mapping nor a list of mappings", node)
        yield inner


def _text(node: ScalarNode) -> str:
    """Return the text of a scalar; a surrogate pair, as JSON writes it, becomes its character."""
    text = str(node.value)
    if text.isprintable():
        return text
    try:
        whole = text.encode("utf-16", "surrogatepass").decode("utf-16")
    except UnicodeDecodeError:
        whole = "\0"
    if _CONTROL.search(whole):
        raise _wrong(f"a control character in {shown(text)}", node)
    return whole


def _scalar(node: ScalarNode) -> Any:
    text = _text(node)
    if node.tag and not node.tag.startswith(_CORE):
        raise _wrong(f"the tag {_tag(node)}", node, "Leave it out")
    try:
        if node.tag:
            return tagged_value(node.tag.removeprefix(_CORE), text)
        return plain_value(text) if node.style is None else text
    except NotAValueError as error:
        raise _wrong(error.found, node, error.fix) from None


def _require_bounds(depth: int, count: int, node: Node | None) -> None:
    if depth > MOST_DEPTH:
        raise _wrong(f"values that lie deeper than {MOST_DEPTH} within one another", node)
    if count > MOST_VALUES:
        raise _wrong(f"more than {MOST_VALUES:,} values, each alias counted as what it stands for", node)


def _tag(node: Node) -> str:
    return str(node.tag).replace(_CORE, "!!")


def _wrong(problem: str, node: Node | None, fix: str = "") -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark if node else None, note=fix or None)
