"""Plain language: no private words in pages, messages, docstrings, comments and names; no long sentence in a page.

CONTRIBUTING.md explains the rules. An exception is one entry of ALLOWED or ALLOWED_NAMES.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from paths import ROOT

WRITE_INSTEAD = {  # a regular expression for whole words, and what to write instead
    r"knobs?": "option or config key",
    r"anew": "again",
    r"foretell|foretells|foretold": "predict, show or print",
    r"beside": "next to, in addition to or compared with",
    r"taught": "seen in training",
    r"nobody|somebody|everybody|strangers?": "no method, all users or third parties",
    r"told|tellers?": "reported or logged; a model",
    r"wanted|asked for": "required or requested",
    r"alike": "the same, or similar",
    r"(?:lies|stands|lie|stand) (?:in|at|on|under|there)": "is in, or is stored in",
    r"(?:go|goes|going|went|gone) on": "resume or continue",
    r"ways? out": "fix",
    r"held against": "compared with",
    r"so-many-th": "n-th",
    r"films?": "video",
    r"postcards?|watchm[ae]n": "HTML export; anomaly monitor",
    r"doing nothing": "persistence (prediction) or zero action (control)",
}
ALLOWED = {  # file: the words as they are written there
    "src/vjepa2_ac/simulation/benchmark.py": {"films"},  # the option simulate --films
    "src/vjepa2_ac/cli/closed_loop.py": {"films"},
}
PRIVATE_NAME = re.compile(
    "(?:^|_)(?:found|its|told|tells|asked|asks|kept|there|wanted|others|taken|given|anew|taught|beside|knob|nobody)(?:_|$)"
    "|(?:^|_)ones?$",
    flags=re.IGNORECASE,
)
ALLOWED_NAMES = {
    "config/data.py: shortest_kept_steps",  # config keys
    "config/training.py: others",
    "planning/solvers.py: kept",
    "errors.py: found",  # the keyword of every error: what was found
    "data/index.py: found",  # keys of files
    "policies/score.py: others_below_true",
}
MOST_WORDS = 30  # in a sentence of a page

GUIDES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")), *sorted(ROOT.glob("docs/*.md"))]
MODULES = sorted((ROOT / "src").rglob("*.py"))
ASSETS = [
    path
    for path in sorted((ROOT / "src").rglob("*"))
    if path.suffix in {".yaml", ".jinja", ".js", ".html"} and "golden" not in path.parts
]


def prose(page: str) -> Iterator[str]:
    """Yield the text of each paragraph, heading and table cell; inline code becomes the word `code`."""
    for token in MarkdownIt().enable("table").parse(page):
        for child in token.children or []:
            if child.type == "code_inline":
                child.content = "`code`"
            elif child.type in {"softbreak", "hardbreak"}:
                child.content = " "
        if token.type == "inline":
            yield "".join(child.content for child in token.children or [] if child.type != "html_inline")


def texts(module: str) -> Iterator[str]:
    """Yield the strings, docstrings and comments of a module."""
    for node in ast.walk(ast.parse(module)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
    for token in tokenize.generate_tokens(io.StringIO(module).readline):
        if token.type == tokenize.COMMENT:
            yield token.string


def names(module: str) -> Iterator[str]:
    """Yield the identifiers that a module defines."""
    for node in ast.walk(ast.parse(module)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def private_words(path: Path, parts: Iterator[str]) -> list[str]:
    allowed = ALLOWED.get(str(path.relative_to(ROOT)), set())
    text = re.sub(r"\s+", " ", "\n".join(parts))
    return [
        f"{path.relative_to(ROOT)}: {text[max(match.start() - 40, 0) : match.end() + 40]!r}: write {replacement}"
        for words, replacement in WRITE_INSTEAD.items()
        for match in re.finditer(rf"\b(?:{words})\b", text, flags=re.IGNORECASE)
        if match[0].lower() not in allowed
    ]


def sentences(text: str) -> list[str]:
    return re.split(r"(?<=[.!?])[\")]*\s+(?=[A-Z`\"(\d]|int8)", text)


def test_pages_use_standard_terms() -> None:
    pages = [*GUIDES, ROOT / "CHANGELOG.md"]
    wrong = [line for path in pages for line in private_words(path, prose(path.read_text()))]
    assert not wrong, "\n".join(wrong)


def test_messages_docstrings_and_comments_use_standard_terms() -> None:
    wrong = [line for path in MODULES for line in private_words(path, texts(path.read_text()))]
    wrong += [line for path in ASSETS for line in private_words(path, iter([path.read_text()]))]
    assert not wrong, "\n".join(wrong)


def test_names_contain_no_private_words() -> None:
    package = ROOT / "src/vjepa2_ac"
    wrong = {
        f"{path.relative_to(package)}: {name}"
        for path in MODULES
        for name in names(path.read_text())
        if PRIVATE_NAME.search(name)
    }
    assert not wrong - ALLOWED_NAMES, "\n".join(sorted(wrong - ALLOWED_NAMES))
    assert not ALLOWED_NAMES - wrong, "these exceptions are not needed any more"


def test_sentences_of_pages_are_short() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}: {len(sentence.split())} words: {sentence}"
        for path in GUIDES
        for text in prose(path.read_text())
        for sentence in sentences(text)
        if len(sentence.split()) > MOST_WORDS
    ]
    assert not wrong, f"at most {MOST_WORDS} words:\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "words"), [("Each knob has a default.", "knob"), ("It is told\nto the robot.", "told")]
)
def test_private_word_is_reported(text: str, words: str) -> None:
    assert words in private_words(ROOT / "README.md", iter([text]))[0]
